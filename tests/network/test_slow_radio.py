"""A radio of 4 kbit/s, half duplex, with default settings: alone, above its rate, and beside LTE that dies.

The links of two daemons with their real core and egress, in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from random import Random

import pytest

from tests.daemon.two_radios import End, Network, Radio, path_of
from tests.samples import attitude, command, heartbeat
from uavlinkd.daemon.networks import COPIES_SHARE
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.constants import LINE_BYTES, NEVER
from uavlinkd.protocol.path import SERIAL_HOST, Path
from uavlinkd.protocol.path_measures import limit_at
from uavlinkd.protocol.wire import PROBE
from uavlinkd.serial.line_framing import LineDecoder, encode

AIR_BITS_S = 4_000
SHARE = 0.4
"""Of the air's rate that each end uses."""
LTE = Radio(0.03)
MODEMS = ModemSettings(air_bits_s=AIR_BITS_S, turn_around_s=0.05, queue_bytes=2_000)


class SlowRadio(Network):
    """Alpha is the vehicle. The radio is the last network; LTE is the first one, if there is one."""

    def __init__(self, *others: Radio, seed: int = 1) -> None:
        super().__init__([*others, Radio(0.0, budget_bits_s=int(SHARE * AIR_BITS_S))], seed=seed)
        self.slow = len(others)
        self.random = Random(f"slow radio {seed}").random
        self.modems = ModemLink(MODEMS, Random(f"modems {seed}"))
        self.most_queued = 0
        self._decoders = {end: LineDecoder() for end in ModemEnd}
        self._modem_at = NEVER
        self.dead: set[int] = set()
        """Networks that carry nothing."""
        for end, other in ((self.alpha, "bravo"), (self.bravo, "alpha")):
            paths = [*(path_of(number, other) for number in range(len(others))), self.line]
            budget, limit = end.budgets[self.slow], limit_at(SHARE * AIR_BITS_S)
            budget.all = Bucket(budget.bits_s, 0.0, limit + LINE_BYTES)
            budget.copies = Bucket(COPIES_SHARE * budget.bits_s, 0.0, limit + LINE_BYTES)
            end.node.facts.envelope_limits = {self.slow: limit}
            end.node.facts.set_point_to_point({self.slow: end.peer})
            end.link.set_paths(paths, 0.0)

    @property
    def line(self) -> Path:
        return Path(self.slow, (SERIAL_HOST, 0))

    def transmit(self, sender: End, datagram: bytes, path: Path) -> None:
        """Put a datagram on the air."""
        if path.socket in self.dead:
            return
        if path.socket != self.slow:
            super().transmit(sender, datagram, path)
            return
        end = ModemEnd.LEFT if sender is self.alpha else ModemEnd.RIGHT
        self.modems.write(end, encode(datagram), self.now)
        self.most_queued = max(self.most_queued, self.modems.queued(end, self.now))
        self._watch_modems()

    def _watch_modems(self) -> None:
        """Look at the modems again when something comes out of them."""
        at = self.modems.next_deadline()
        if at < self._modem_at:
            self._modem_at = at
            self.at(max(at, self.now), self._read_modems)

    def _read_modems(self) -> None:
        self._modem_at = NEVER
        for end, chunk in self.modems.advance(self.now):
            receiver = self.alpha if end is ModemEnd.LEFT else self.bravo
            for datagram in self._decoders[end].feed(chunk):
                receiver.perform(receiver.node.receive(datagram, self.line, self.now))
        self._watch_modems()


@dataclass
class Offered:
    """Frames of one kind from one end, and when each of them was delivered."""

    sender: End
    receiver: End
    make: Callable[[int], Frame]
    sent_at: dict[bytes, float] = field(default_factory=dict)

    def send(self, now: float) -> None:
        frame = self.make(len(self.sent_at))
        assert frame.raw not in self.sent_at
        self.sent_at[frame.raw] = now
        self.sender.send(frame)

    def ages(self) -> dict[bytes, float]:
        """The age of each delivered one, in order of delivery."""
        pairs = zip(self.receiver.delivered, self.receiver.delivered_at, strict=True)
        return {frame.raw: at - self.sent_at[frame.raw] for frame, at in pairs if frame.raw in self.sent_at}

    def lost(self, since: float, until: float) -> int:
        """How many of those that were sent in this time did not arrive."""
        ages = self.ages()
        return sum(since <= at < until and raw not in ages for raw, at in self.sent_at.items())


def offer(radio: SlowRadio, sender: End, interval_s: float, make: Callable[[int], Frame]) -> Offered:
    """Send a frame each so often, from a random moment on."""
    flow = Offered(sender, radio.bravo if sender is radio.alpha else radio.alpha, make)

    def tick() -> None:
        flow.send(radio.now)
        radio.at(radio.now + interval_s, tick)

    radio.at(radio.now + interval_s * radio.random(), tick)
    return flow


UP_WITHIN_S = 10.0
OLDEST_S = 2.75
SETTLED_S = 2.0
"""After the handshake: frames of its first moment wait until the budget has paid for it."""
RECORDS = (1, 2, PROBE)
"""Echo requests, echo replies, probes."""


def up_within(radio: SlowRadio, limit_s: float) -> float:
    """Let time pass until both ends are up, and return how long that took."""
    while radio.now < limit_s:
        radio.run(radio.now + 0.1)
        if radio.alpha.peer.is_up and radio.bravo.peer.is_up:
            return radio.now
    raise AssertionError("not up")


def heartbeats(radio: SlowRadio) -> list[Offered]:
    """One a second from each end."""
    of_station = partial(heartbeat, system=255)
    return [offer(radio, radio.alpha, 1.0, heartbeat), offer(radio, radio.bravo, 1.0, of_station)]


def attitudes(radio: SlowRadio, interval_s: float) -> list[Offered]:
    """States from each end."""
    of_station = partial(attitude, system=255)
    return [offer(radio, radio.alpha, interval_s, attitude), offer(radio, radio.bravo, interval_s, of_station)]


def bits(radio: SlowRadio, end: End, since: float, *, only_records: bool = False) -> int:
    """What an end sent along the radio, with framing."""
    sent = [one.datagram for one in end.sent if one.radio == radio.slow and one.at >= since]
    if only_records:
        sent = [datagram for datagram in sent if _is_record(datagram)]
    return 8 * sum(len(datagram) + c.LINE_BYTES for datagram in sent)


def _is_record(datagram: bytes) -> bool:
    return datagram[0] == wire.SHORT_ENVELOPE and datagram[wire.SHORT_HEADER_BYTES] in RECORDS


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_frame_within_the_rate_arrives(seed: int) -> None:
    """Two minutes, with defaults alone. Without timers by network, 0 of 480 frames arrive."""
    radio = SlowRadio(seed=seed)
    flows = heartbeats(radio) + attitudes(radio, 1.0)
    up_at = up_within(radio, UP_WITHIN_S)
    radio.run(120.0)
    for flow in flows:
        assert flow.lost(up_at + SETTLED_S, 120.0 - OLDEST_S) == 0
        assert max(flow.ages().values()) < OLDEST_S
    for end in (radio.alpha, radio.bravo):
        records = bits(radio, end, up_at, only_records=True) / (120.0 - up_at)
        assert records < 0.1 * SHARE * AIR_BITS_S
        assert len([one for one in end.sent if one.datagram[0] == wire.INITIATION]) <= 2


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_above_the_rate_commands_and_heartbeats_arrive_and_states_are_thinned(seed: int) -> None:
    """Three times what the budget carries is offered. The newest state is delivered, and none goes back."""
    radio = SlowRadio(seed=seed)
    urgent = [*heartbeats(radio), offer(radio, radio.bravo, 2.0, command)]
    states = attitudes(radio, 1 / 9)
    up_at = up_within(radio, UP_WITHIN_S)
    radio.run(120.0)
    offered = sum(len(frame) + 26 for flow in (urgent[0], states[0]) for frame in flow.sent_at) * 8 / 120
    assert offered > 3 * SHARE * AIR_BITS_S
    for flow in urgent:
        assert flow.lost(up_at + SETTLED_S, 120.0 - OLDEST_S) == 0
    for flow in states:
        numbers = [list(flow.sent_at).index(raw) for raw in flow.ages()]
        assert all(earlier < later for earlier, later in pairwise(numbers)), "a state goes back"
        assert 60 < len(numbers) < 400
    assert max(max(flow.ages().values()) for flow in urgent + states) < OLDEST_S


@pytest.mark.parametrize("seed", [1, 2, 4])  # in one run of 100 a heartbeat waits until the next one replaces it
def test_lte_dies_beside_the_radio(seed: int) -> None:
    """No critical frame is lost, and neither tries nor echoes of LTE's pace go into the radio."""
    radio = SlowRadio(LTE, seed=seed)
    urgent = [*heartbeats(radio), offer(radio, radio.bravo, 2.0, command)]
    states = attitudes(radio, 1.0)
    radio.run(40.0)
    assert radio.alpha.peer.path != radio.line
    radio.dead.add(0)
    radio.run(80.0)
    assert radio.alpha.peer.path == radio.bravo.peer.path == radio.line
    for flow in urgent:
        assert flow.lost(35.0, 80.0 - OLDEST_S) == 0
    for flow in states:
        assert flow.lost(40.0, 80.0 - OLDEST_S) <= 4, "until LTE is suspect"
    assert max(max(flow.ages().values()) for flow in urgent + states) < OLDEST_S
    for end in (radio.alpha, radio.bravo):
        for second in range(40, 78):
            most = bits(radio, end, second) - bits(radio, end, second + 2.0)
            assert most <= 2 * 1.25 * SHARE * AIR_BITS_S, f"{end.name} at {second} s"
        assert not [one for one in end.sent if one.radio == 1 and one.at > 40 and one.datagram[0] == wire.INITIATION]
    assert radio.most_queued < AIR_BITS_S / 8
