"""The frames that a vehicle and its ground station offer, and what arrived of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

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
