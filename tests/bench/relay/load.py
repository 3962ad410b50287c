"""A relay under load: what it loses, how long a datagram takes, and what a datagram costs."""

from __future__ import annotations

import math
import select
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol

from tests.bench.relay.volleys import Flow, Hosts, Received
from uavlinkd.lab.evaluation.records import cpu_seconds

PAYLOAD_BYTES: Final = 100
"""An envelope with a few frames of telemetry."""
SENT_AT_ONCE: Final = 32
LAST_S: Final = 0.5
"""How long datagrams may take at the end of a run."""
TIMERS_S: Final = 0.02
RELAY_CORE: Final = 0
LOAD_CORE: Final = 1


class Relayed(Protocol):
    """Pairs of hosts at a running relay."""

    name: str
    hosts: Hosts
    data_start: int
    """The first byte of what the relay forwards to a host."""

    @property
    def flows(self) -> Sequence[Flow]:
        """One for each direction of each pair."""

    def pid(self) -> int:
        """Of the relay's process."""

    def take(self, received: Received, now: float) -> None:
        """Something other than data arrived."""

    def do_timers(self, now: float) -> None:
        """Do what is due."""


class Measured(NamedTuple):
    """The figures of one rate."""

    offered_s: float
    """Datagrams a second that were sent to the relay."""
    lost: float
    """Share of them."""
    delay_ms: float
    """Median, from the sending call to the receiving one."""
    slowest_ms: float
    """99 % are faster."""
    cpu_us: float
    """Processor time of the relay for a datagram."""

    @property
    def capacity_s(self) -> float:
        """Datagrams a second that fit one core."""
        return 1e6 / self.cpu_us


class Generator:
    """Sends along the flows of a relay and receives what comes back, on a core of its own."""

    def __init__(self, relay: Relayed) -> None:
        self.relay = relay
        self._poll = select.poll()
        self._poll.register(relay.hosts.readable, select.POLLIN)
        self._timers_at = 0.0

    def turn(self, timeout_s: float) -> None:
        """Receive what is there, and do what is due."""
        relay = self.relay
        if timeout_s:
            self._poll.poll(timeout_s * 1000)
        for received in relay.hosts.receive(relay.data_start):
            relay.take(received, time.monotonic())
        if (now := time.monotonic()) >= self._timers_at:
            self._timers_at = now + TIMERS_S
            relay.do_timers(now)

    def until(self, condition: Callable[[], bool], timeout_s: float) -> None:
        began = time.monotonic()
        while not condition():
            if time.monotonic() > began + timeout_s:
                raise TimeoutError
            self.turn(0.001)

    def run(self, rate_s: int, seconds: float) -> Measured:
        """Each host sends at this rate."""
        hosts, flows = self.relay.hosts, self.relay.flows
        load = hosts.load(flows, PAYLOAD_BYTES)
        hosts.received, hosts.delays_ns = 0, []
        cpu_s, began, sent = cpu_seconds(self.relay.pid()), time.monotonic(), 0
        while (now := time.monotonic()) < began + seconds:
            due = int((now - began) * rate_s * len(flows)) - sent
            if due > 0:
                sent += load.send(min(due, SENT_AT_ONCE))
            self.turn(0.0)
        elapsed_s = time.monotonic() - began
        end = time.monotonic() + LAST_S
        while time.monotonic() < end and hosts.received < sent:
            self.turn(0.01)
        delays_ms = statistics.quantiles((delay / 1e6 for delay in hosts.delays_ns or (math.nan, math.nan)), n=100)
        cpu_us = (cpu_seconds(self.relay.pid()) - cpu_s) / max(1, hosts.received) * 1e6
        return Measured(sent / elapsed_s, 1 - hosts.received / sent, delays_ms[49], delays_ms[98], cpu_us)


def host(number: int) -> str:
    """An address of its own on loopback for each host."""
    return f"127.1.{number // 250}.{number % 250 + 1}"
