"""A radio that carries less than the file says, half duplex, in virtual time: the link comes up, and frames pass.

Two daemons' links with the real core, egress, serial networks and their lines. Only the devices are emulated modems.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from random import Random
from types import SimpleNamespace
from typing import Any, cast

import pytest
import structlog

from tests.endpoints.inside import set_device
from tests.link.two_radios import End, Network, Radio
from tests.network.test_slow_radio import Offered, attitudes, heartbeats, up_within
from uavlinkd.config.model import NetworkConfig
from uavlinkd.config.network_rules import SENDING_SHARE
from uavlinkd.core.path import Path
from uavlinkd.endpoints import serial_line
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings
from uavlinkd.link import serial_networks
from uavlinkd.link.serial_networks import SerialNetworks
from uavlinkd.system.stall import StallWatch

BAUD = 57_600


class Timer:
    """What an event loop returns for a call later."""

    def __init__(self, function: Callable[[], None]) -> None:
        self.run = function

    def cancel(self) -> None:
        self.run = lambda: None


class OverstatedRadio(Network):
    """Both files say the same: more than the modems carry. It is the event loop of the lines, too."""

    def __init__(self, patch: pytest.MonkeyPatch, says_bits_s: int, carries_bits_s: int, seed: int) -> None:
        budget_bits_s = int(SENDING_SHARE * says_bits_s)
        super().__init__([Radio(0.0, budget_bits_s=budget_bits_s)], seed=seed)
        for module in (serial_line, serial_networks):
            patch.setattr(module, "monotonic", lambda: self.now)
        patch.setattr(asyncio, "get_running_loop", lambda: self)
        patch.setattr(os, "write", self._write)
        self.random = Random(f"overstated {seed}").random
        modems = ModemSettings(air_bits_s=carries_bits_s, turn_around_s=0.05, queue_bytes=2_000, line_baud=BAUD)
        self.modems = ModemLink(modems, Random(f"modems {seed}"))
        self.serial: dict[End, SerialNetworks] = {}
        self._ends = dict(zip(ModemEnd, (self.alpha, self.bravo), strict=True))
        self._read_at = float("inf")
        for number, (place, end) in enumerate(self._ends.items()):
            config = NetworkConfig(
                "sik", budget_bits_s=budget_bits_s, serial=SerialUrl("modem", BAUD), air_bits_s=says_bits_s
            )
            stall = StallWatch(0.0, lambda pause_s: None)
            serial = self.serial[end] = SerialNetworks([config], 0, end.node, stall, structlog.get_logger())
            (network,) = serial.networks
            device = SimpleNamespace(fileno=partial(int, number), num_unwritten_bytes=partial(self._unwritten, place))
            set_device(network.line, device)
            end.budgets.update(serial.budgets(0.0))
            end.node.facts.envelope_limits = {0: network.envelope_limit}
            end.node.facts.set_point_to_point({0: end.peer})
            end.link.set_paths([network.path], 0.0)
            self.at(self.random(), partial(self._keep_house, end))

    def _keep_house(self, end: End) -> None:
        """As a daemon does once a second."""
        serial = self.serial[end]
        serial.do_housekeeping()
        if rates := serial.follow_rates(end.budgets, [end.link], self.now):
            end.node.set_rates(rates, self.now)
        self.at(self.now + 1.0, partial(self._keep_house, end))

    def transmit(self, sender: End, datagram: bytes, path: Path) -> None:
        self.serial[sender].networks[0].line.send(datagram)

    def call_later(self, delay_s: float, function: Callable[[], None]) -> Timer:
        """As an event loop."""
        timer = Timer(function)
        self.at(self.now + delay_s, lambda: timer.run())  # noqa: PLW0108 - it may be cancelled meanwhile
        return timer

    def _unwritten(self, place: ModemEnd) -> int:
        return self.modems.unwritten(place, self.now)

    def _write(self, number: int, data: bytes) -> int:
        written = self.modems.write(list(ModemEnd)[number], data, self.now)
        self._watch()
        return written

    def _watch(self) -> None:
        at = self.modems.next_deadline()
        if at < self._read_at:
            self._read_at = at
            self.at(max(at, self.now), self._read)

    def _read(self) -> None:
        self._read_at = float("inf")
        for place, chunk in self.modems.advance(self.now):
            end = self._ends[place]
            (network,) = self.serial[end].networks
            network.line.bytes_received += len(chunk)
            for datagram in network.line.decoder.feed(chunk):
                end.perform(end.node.receive(datagram, network.path, self.now))
        self._watch()


def longest_gap(flow: Offered, since: float, until: float) -> float:
    """The longest time without a delivery."""
    times = sorted(flow.sent_at[raw] + age for raw, age in flow.ages().items())
    return max(later - earlier for earlier, later in pairwise([since, *(at for at in times if since <= at), until]))


SECONDS = 60.0
UP_WITHIN_S = 10.0
SETTLED_S = 10.0
"""After the handshake: the queue in the modems empties."""
LONGEST_GAP_S = 3.5


@pytest.mark.parametrize(("says", "carries"), [(8_000, 4_000), (16_000, 4_000), (24_000, 4_000), (57_600, 9_600)])
@pytest.mark.parametrize("seed", range(3))
def test_link_over_a_radio_that_carries_less_than_the_file_says(
    monkeypatch: pytest.MonkeyPatch, says: int, carries: int, *, seed: int
) -> None:
    """Heartbeats and a state a second from each end. No heartbeat is lost."""
    radio = OverstatedRadio(monkeypatch, says, carries, seed)
    flows = heartbeats(cast(Any, radio))
    attitudes(cast(Any, radio), 1.0)
    since = up_within(cast(Any, radio), UP_WITHIN_S) + SETTLED_S
    radio.run(SECONDS)
    for flow in flows:
        assert flow.lost(since, SECONDS - 3.0) == 0
        assert longest_gap(flow, since, SECONDS) < LONGEST_GAP_S
