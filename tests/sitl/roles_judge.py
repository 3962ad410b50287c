"""The judge: what a role must not change in an autopilot, before and after, and all the time."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from tests.sitl.roles_station import ARMED, PLANS, Station, StationError

METRES_PER_DEGREE: Final = 111_320.0
HOLD_M: Final = 5.0
"""How far a vehicle that holds its position, or stands, may be from where it was."""
HOME_M: Final = 2.0
"""ArduPilot moves home with its estimate while it is disarmed."""
RATE_WINDOW_S: Final = 10.0
RATE_SHARE: Final = 0.34
CLOCK_S: Final = 1.0
_HOME, _ORIGIN, _TARGET = 242, 49, 87
_REPEATED: Final = frozenset({"STATUSTEXT", "PARAM_VALUE", "COMMAND_ACK", "TIMESYNC", "EVENT"})
"""Not streams: sent on request, or at an event."""

Place = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude in metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """What an autopilot's state is."""

    armed: bool
    mode: int
    parameters: Mapping[str, bytes]
    plans: Mapping[int, tuple[bytes, ...]]
    home: Place | None
    origin: Place | None
    target: Place | None
    clock_s: float | None
    """Unix time at its start."""
    rates: Mapping[str, float] = field(default_factory=dict)
    """Messages a second on both links; only in the first and last snapshot of a scene."""


class Judge:
    """Watches one autopilot. `changes` lists what must not have happened."""

    def __init__(self, station: Station) -> None:
        self.station = station
        self.changes: list[str] = []
        self._mode: tuple[bool, int] | None = None
        self._place: Place | None = None
        self.farthest_m = 0.0

    def begin(self) -> None:
        """Note mode and position: from now on, each message of the autopilot is compared with them."""
        seen = self.station.seen
        self.station.until(lambda: {"HEARTBEAT", "GLOBAL_POSITION_INT"} <= seen.latest.keys(), "its state")
        self._mode = _mode_of(seen.latest["HEARTBEAT"])
        self._place = _place_of(seen.latest["GLOBAL_POSITION_INT"])
        seen.texts.clear()
        self.farthest_m = 0.0
        self.changes.clear()
        self.station.on_message = self._watch

    def snapshot(self, *, with_rates: bool = False) -> Snapshot:
        """Ask the autopilot for its whole state.

        Raises:
            StationError: it does not answer.
        """
        station = self.station
        rates = self._rates() if with_rates else {}
        home = station.request("HOME_POSITION", _HOME)
        origin = station.request("GPS_GLOBAL_ORIGIN", _ORIGIN)
        target = station.request("POSITION_TARGET_GLOBAL_INT", _TARGET)
        clock = station.request("SYSTEM_TIME", 2)
        armed, mode = _mode_of(station.seen.latest["HEARTBEAT"])
        return Snapshot(
            armed=armed,
            mode=mode,
            parameters=station.read_parameters(),
            plans={plan: station.read_plan(plan) for plan in PLANS},
            home=_home_of(home),
            origin=_home_of(origin),
            target=_target_of(target),
            clock_s=clock.time_unix_usec / 1e6 - clock.time_boot_ms / 1e3 if clock else None,
            rates=rates,
        )

    def _rates(self) -> dict[str, float]:
        """Messages a second of the autopilot's time, on both links."""
        station = self.station
        station.wait_for_attacker()
        station.pass_time(RATE_WINDOW_S / 2)  # answers to what was sent before end meanwhile
        began_s, own, attacker = station.time_s, station.seen.number.copy(), station.sent_to_attacker.copy()
        station.pass_time(RATE_WINDOW_S)
        seconds = station.time_s - began_s
        rates = _per_second(station.seen.number - own, seconds, "")
        return rates | _per_second(station.sent_to_attacker - attacker, seconds, " to the attacker")

    def _watch(self, message: Any) -> None:
        name = message.get_type()
        if name == "HEARTBEAT" and (mode := _mode_of(message)) != self._mode:
            self._report(f"armed and mode: {self._mode} became {mode}")
            self._mode = mode
        elif name == "GLOBAL_POSITION_INT" and self._place is not None:
            distance_m = distance(self._place, _place_of(message))
            if distance_m > HOLD_M >= self.farthest_m:
                self._report(f"position: the vehicle left its place by more than {HOLD_M:g} m")
            self.farthest_m = max(self.farthest_m, distance_m)

    def _report(self, change: str) -> None:
        self.changes.append(f"{change} at {self.station.time_s:.1f} s")


def differences(before: Snapshot, after: Snapshot, own: Iterable[str] = ()) -> list[str]:
    """What changed from one snapshot to the other. `own`: the parameters that the autopilot changes by itself."""
    changes = []
    for name in ("armed", "mode"):
        if getattr(before, name) != getattr(after, name):
            changes.append(f"{name}: {getattr(before, name)} became {getattr(after, name)}")
    for name in sorted(changed_parameters(before, after) - set(own)):
        old, new = (snapshot.parameters.get(name, b"").hex() or "missing" for snapshot in (before, after))
        changes.append(f"parameter {name}: {old} became {new}")
    for plan, items in before.plans.items():
        if items != after.plans[plan]:
            changes.append(f"plan {plan}: {len(items)} items became {len(after.plans[plan])}, or others")
    for name, limit_m in (("home", HOME_M), ("origin", 0.01), ("target", HOLD_M)):
        old, new = getattr(before, name), getattr(after, name)
        if (old is None) != (new is None) or (old and new and not distance(old, new) <= limit_m):
            changes.append(f"{name}: {old} became {new}")
    if before.clock_s is not None and after.clock_s is not None and abs(before.clock_s - after.clock_s) > CLOCK_S:
        changes.append(f"clock: jumped by {after.clock_s - before.clock_s:.1f} s")
    return changes + changed_rates(before.rates, after.rates)


def changed_parameters(before: Snapshot, after: Snapshot) -> set[str]:
    """The names of parameters that one snapshot lacks or has with another value."""
    names = before.parameters.keys() | after.parameters.keys()
    return {name for name in names if before.parameters.get(name) != after.parameters.get(name)}


def changed_rates(before: Mapping[str, float], after: Mapping[str, float]) -> list[str]:
    """Streams that became faster or slower, began or ended. One message in the window may be a coincidence."""
    changes = []
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name, 0.0), after.get(name, 0.0)
        is_stream = name.removesuffix(" to the attacker") not in _REPEATED
        if is_stream and abs(old - new) > max(RATE_SHARE * max(old, new), 3 / RATE_WINDOW_S):
            changes.append(f"rate of {name}: {old:.2f}/s became {new:.2f}/s")
    return changes


def distance(a: Place, b: Place) -> float:
    """Metres between two places that are near each other. NaN if either is not a place."""
    north = (a[0] - b[0]) * METRES_PER_DEGREE
    east = (a[1] - b[1]) * METRES_PER_DEGREE * math.cos(math.radians(a[0]))
    return math.hypot(north, east, a[2] - b[2])


def _per_second(number: Counter[str], seconds: float, suffix: str) -> dict[str, float]:
    if seconds <= 0:
        raise StationError("the autopilot's time does not pass")
    return {name + suffix: count / seconds for name, count in number.items()}


def _mode_of(heartbeat: Any) -> tuple[bool, int]:
    return bool(heartbeat.base_mode & ARMED), int(heartbeat.custom_mode)


def _place_of(position: Any) -> Place:
    return position.lat / 1e7, position.lon / 1e7, position.relative_alt / 1e3


def _home_of(message: Any | None) -> Place | None:
    if message is None:
        return None
    return message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3


def _target_of(message: Any | None) -> Place | None:
    if message is None:
        return None
    return message.lat_int / 1e7, message.lon_int / 1e7, float(message.alt)
