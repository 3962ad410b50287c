"""What attacks on the line between two emulated modems achieve: nothing. In virtual time.

Two daemons' peer links with the real core and the framing of lines. Unlike daemons they send at one rate, also when
answers come late. The left end is ``alpha``, the right one ``bravo``; each has the other's line in its configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from random import Random
from typing import Any, Final

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.link.two_radios import End, Network, Radio
from uavlinkd.config.network_rules import SENDING_SHARE
from uavlinkd.core.constants import LINE_BYTES
from uavlinkd.core.path import SERIAL_HOST, Path
from uavlinkd.core.path_measures import limit_at
from uavlinkd.core.settings import Link
from uavlinkd.endpoints.line_framing import LineDecoder, encode
from uavlinkd.lab.mitm.attack import Intervention
from uavlinkd.lab.mitm.line_attacks import LINE_ATTACKS, LineAttacker, parse_line_attack
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import SplitCounters, split_payload

Message = Any  # a pymavlink message: pymavlink has no types
Make = Callable[[int], Message]

VEHICLE, STATION = 1, 255
CRITICAL: Final = frozenset({mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_COMMAND_LONG})

# Every field that could be zero is not: pymavlink truncates zeros at the end of a payload.
_TELEMETRY: Final[Mapping[Make, float]] = {
    lambda n: mavlink.MAVLink_attitude_message(n, 0.1, 0.2, 1.5, 0.01, 0.02, 0.03): 4.0,
    lambda n: mavlink.MAVLink_global_position_int_message(
        n, 473_977_420, 85_455_940, 500_000, 12_000, 100, 90, -5, 9_000
    ): 3.0,
    lambda n: mavlink.MAVLink_vfr_hud_message(12.0, 11.5, 90, 45, 488.0, n + 0.5): 2.0,
    lambda n: mavlink.MAVLink_gps_raw_int_message(
        n, 3, 473_977_420, 85_455_940, 500_000, 90, 120, 1_150, 9_000, 14
    ): 2.0,
    lambda n: mavlink.MAVLink_sys_status_message(7, 7, 7, 1 + n % 65_535, 15_900, 1_200, 80, 1, 1, 1, 1, 1, 1): 1.0,
    lambda n: mavlink.MAVLink_nav_controller_output_message(1.0, 0.5, 90, 91, 100, 2.0, 0.5, n + 0.5): 1.0,
    lambda n: mavlink.MAVLink_rc_channels_message(n, 8, *range(1_000, 1_018), 200): 1.0,
}
"""Messages and their rates in Hz: what a ground station requests of a copter over a slow radio."""


def _heartbeat(number: int) -> Message:
    return mavlink.MAVLink_heartbeat_message(2, 3, 81, number, 4, 3)


def _command(number: int) -> Message:
    return mavlink.MAVLink_command_long_message(1, 1, 511, 0, number, 100_000, 1, 1, 1, 1, 1)


@dataclass(frozen=True, slots=True)
class Offered:
    at: float
    system: int
    message: Message

    @property
    def is_critical(self) -> bool:
        return int(self.message.get_msgId()) in CRITICAL


def offered(until: float, factor: float) -> list[Offered]:
    """The messages of ``until`` seconds. ``factor``: that of the telemetry's rates. Heartbeats keep theirs."""
    made = [*_every(1.0, until, VEHICLE, _heartbeat), *_every(1.0, until, STATION, _heartbeat)]
    made += _every(2.0, until, STATION, _command)
    for make, rate in _TELEMETRY.items():
        made += _every(1 / (rate * factor), until, VEHICLE, make)
    return sorted(made, key=lambda one: one.at)


def _every(interval_s: float, until: float, system: int, make: Make) -> Iterator[Offered]:
    for number in range(int(until / interval_s)):
        # Streams do not begin at one moment: the golden ratio spreads them.
        at = (number + (len(str(make(1))) * 0.618) % 1) * interval_s
        yield Offered(at, system, make(number + 1))


@dataclass
class Arrivals:
    """Frames by their bytes: when they were sent, and what arrived."""

    sent: dict[bytes, tuple[float, Offered]] = field(default_factory=dict)
    ages_s: dict[bytes, float] = field(default_factory=dict)
    foreign: int = 0
    """Delivered frames that were not sent, or were delivered before."""

    def send(self, frame: bytes, what: Offered, now: float) -> None:
        self.sent[frame] = now, what

    def deliver(self, frame: bytes, now: float) -> None:
        if frame not in self.sent or frame in self.ages_s:
            self.foreign += 1
        else:
            self.ages_s[frame] = now - self.sent[frame][0]

    def share(self, system: int, since: float, until: float) -> float:
        """The share of a system's critical frames that arrived, of those sent in this time."""
        chosen = [
            frame
            for frame, (at, what) in self.sent.items()
            if what.system == system and what.is_critical and since <= at <= until
        ]
        return sum(frame in self.ages_s for frame in chosen) / len(chosen)


LINE: Final = Path(0, (SERIAL_HOST, 0))


class LineNetwork(Network):
    """Two ends on a serial line. ``egress`` and ``link``: of both."""

    def __init__(self, modem: ModemSettings, link: Link, egress: EgressSettings, seed: int) -> None:
        self.modems = ModemLink(modem, Random(seed))
        self.decoders = {end: LineDecoder() for end in ModemEnd}
        self.interventions: list[Intervention] = []
        self.attacker = LineAttacker(self.modems, Random(seed), self.interventions.append)
        budget_bits_s = int(SENDING_SHARE * modem.air_bits_s)
        limit = limit_at(budget_bits_s)
        super().__init__([Radio(0.0, budget_bits_s=budget_bits_s)], link, {"alpha": egress, "bravo": egress}, seed)
        self._end_of = {self.alpha: ModemEnd.LEFT, self.bravo: ModemEnd.RIGHT}
        for end in (self.alpha, self.bravo):
            end.node.facts.set_point_to_point({LINE.socket: end.peer})
            end.node.facts.envelope_limits = {LINE.socket: limit}
            end.budgets[LINE.socket].all.set_least_burst(limit + LINE_BYTES)
            end.link.set_paths([LINE], 0.0)

    def transmit(self, sender: End, datagram: bytes, path: Path) -> None:
        assert path == LINE, path
        self.modems.write(self._end_of[sender], encode(datagram), self.now)

    def run(self, until: float) -> None:
        """Let time pass, event by event."""
        ends = {ModemEnd.LEFT: self.alpha, ModemEnd.RIGHT: self.bravo}
        while (at := self._next_event()) <= until:
            self.now = max(self.now, at)
            self.attacker.due(self.now)
            for place, data in self.modems.advance(self.now):
                self.attacker.observe(place, data)
                for datagram in self.decoders[place].feed(data):
                    ends[place].perform(ends[place].node.receive(datagram, LINE, self.now))
            for end in ends.values():
                if end.next_deadline() <= self.now:
                    end.handle_timeout(self.now)
        self.now = until

    def _next_event(self) -> float:
        lines = min(self.modems.next_deadline(), self.attacker.next_deadline())
        return min(lines, self.alpha.next_deadline(), self.bravo.next_deadline())

    def is_linked(self) -> bool:
        """Whether both ends send on a session, along the line."""
        return all(end.peer.sessions.current is not None and end.peer.path is not None for end in self._end_of)


OLDEST_S = 3.5
"""No frame is delivered later than this after it was sent: the limit after a silence (specification, section 11)."""


class Talk:
    """Numbered frames of both ends over a linked pair, checked against what was sent."""

    def __init__(self) -> None:
        self.network = LineNetwork(ModemSettings(), Link(), EgressSettings(coalesce_s=0.1), seed=1)
        self.arrivals = Arrivals()
        self._codec = mavlink.MAVLink(None)
        self._messages = offered(300, 0.5)
        self._began = 0.0
        self._checked = {self.network.alpha: 0, self.network.bravo: 0}

    def link(self) -> None:
        while not self.network.is_linked():
            self.network.run(self.network.now + 0.05)
            assert self.network.now < 30
        self._began = self.network.now

    def send(self, what: Offered) -> None:
        self._codec.srcSystem, self._codec.srcComponent = what.system, 1
        raw = bytes(what.message.pack(self._codec))
        self.arrivals.send(raw, what, self.network.now)
        end = self.network.alpha if what.system == VEHICLE else self.network.bravo
        end.send(*split_payload(raw, SplitCounters()))

    def run(self, seconds: float) -> None:
        """Both ends send for a time."""
        until = self.network.now + seconds
        while (at := self._began + self._messages[0].at) <= until:
            self.network.run(max(at, self.network.now))
            self.send(self._messages.pop(0))
        self.network.run(until)
        self.check()

    def check(self) -> None:
        """Every frame that was delivered was sent, and not delivered before."""
        for end, count in self._checked.items():
            for frame, at in zip(end.delivered[count:], end.delivered_at[count:], strict=True):
                self.arrivals.deliver(frame.raw, at)
            self._checked[end] = len(end.delivered)
        assert not self.arrivals.foreign

    def share(self, since: float) -> float:
        """The smaller share of critical frames that arrived at an end. The newest may still be on air."""
        until = self.network.now - 1
        return min(self.arrivals.share(system, since, until) for system in (VEHICLE, STATION))


@pytest.mark.parametrize("name", sorted(LINE_ATTACKS))
def test_attack_on_the_line_delivers_nothing(name: str) -> None:
    """No frame is forged, altered, repeated or late. When the attack ends, all frames arrive."""
    talk = Talk()
    talk.link()
    talk.run(5)
    interval_s = 15 if name == "line-hold" else 0.3
    attack = parse_line_attack(f"{name},interval_s={interval_s},limit=100")
    talk.network.attacker.change([attack], talk.network.now)
    talk.run(40)
    assert talk.network.interventions
    if name in ("line-forge", "line-replay"):  # these reach the core
        for end in (talk.network.alpha, talk.network.bravo):
            assert end.node.drops.total() + end.peer.traffic.drops.total() > 20
    assert max(talk.arrivals.ages_s.values()) < OLDEST_S
    talk.network.attacker.change([], talk.network.now)
    for place in ModemEnd:
        talk.network.modems.release(place, talk.network.now)
    talk.run(15)
    calm_since = talk.network.now
    talk.run(20)
    assert talk.share(calm_since) == 1.0
