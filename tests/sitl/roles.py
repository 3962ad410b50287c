"""No frame that a role passes may change an autopilot: on the ground, in the air, and while its failsafe trips.

The frames go to it from its tap, after the policy decided: a daemon between would refuse most by the role's rates.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from time import monotonic, monotonic_ns
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.ledger import name_of
from tests.sitl.pilots import COPTER, Mode, Pilot, Place
from tests.sitl.roles_frames import ROLES_TESTED, RoleFrames
from tests.sitl.station import RequestError, Station
from tests.sitl.tables import Item, download_mission, download_parameters, upload_mission
from tests.sitl.transfers import Figures, FlightError
from tests.sitl.world import World

FRAMES = 5000
"""Of each role, on the ground and in the air."""
BATCH = 10
"""Frames until the autopilot has to answer: its input has room for them."""
SEED = 11
STEADY_TRIES = 12
"""How many states of a vehicle may differ from the one before, until it is steady."""
ANSWERED_S = 5.0
"""After the last frame, answers to all of them have been sent."""
TRIES = 60
RATE_WINDOW_S = 10.0
RATE_SHARE = 0.34
CLOCK_S = 1.0
FAILSAFE_S = 60.0
HOLD_M = 5.0
"""How far a vehicle that holds its position, or stands, may be from where it was."""
LIMITS_M = {"HOME_POSITION": 2.0, "GPS_GLOBAL_ORIGIN": 0.01, "POSITION_TARGET_GLOBAL_INT": HOLD_M}
"""ArduPilot moves home with its estimate while it is disarmed."""
COUNTERS = frozenset({"STAT_RUNTIME", "STAT_FLTTIME"})
"""Parameters that ArduPilot changes by itself."""
NO_STREAMS = frozenset({"STATUSTEXT", "PARAM_VALUE", "COMMAND_ACK", "TIMESYNC", "EVENT"})
"""Sent on request, or at an event."""
PLANS = (mavlink.MAV_MISSION_TYPE_MISSION, mavlink.MAV_MISSION_TYPE_FENCE, mavlink.MAV_MISSION_TYPE_RALLY)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The state of an autopilot."""

    exact: Mapping[str, object]
    """Armed state, mode, parameters and plans."""
    places: Mapping[str, Place | None]
    clock_s: float | None
    """Unix time at its start."""
    rates: Mapping[str, float]
    """Messages a second."""


async def roles(world: World, pilot: Pilot) -> Figures:
    """Send frames of each role on the ground and in the air; then let the ground station fall silent meanwhile."""
    await pilot.request_streams()
    await pilot.until_ready()
    for plan, items in _plans(pilot).items():
        try:
            await upload_mission(world.station, pilot.system, items, plan=plan)
        except RequestError:  # some have missions only
            if plan == mavlink.MAV_MISSION_TYPE_MISSION:
                raise
    results: list[Figures] = []
    for place in ("ground", "air"):
        if place == "air":
            await pilot.take_off()
            await pilot.set_mode(Mode.GUIDED)
        before = await steady(world.station, pilot)
        for role in ROLES_TESTED:
            results.append({"role": role, "place": place, **await _attack(world, pilot, role)})
            after = await snapshot(world.station, pilot)
            if changes := differences(before, after):
                raise FlightError(f"{role}, {place}: {'; '.join(changes)}", {"attacks": results})
            before = after
    if pilot.kind is COPTER:
        for role in ROLES_TESTED:
            await _lose_station(world, pilot, role)
    await pilot.return_and_land()
    return {"attacks": results}


async def _attack(world: World, pilot: Pilot, role: str) -> Figures:
    """Send the frames of a role, as long as mode, armed state and position stay."""
    station, system, frames = world.station, pilot.system, RoleFrames(role, SEED)
    state, start, began = (station.mode(system), station.is_armed(system)), pilot.place, monotonic()
    farthest_m = 0.0
    for number in range(0, FRAMES, BATCH):
        batch = await _send(world, pilot, frames)
        farthest_m = max(farthest_m, _apart_m(start, pilot.place))
        now = station.mode(system), station.is_armed(system)
        if now != state or farthest_m > HOLD_M:
            found = f"mode and armed {state} became {now}, {farthest_m:.1f} m from its place"
            raise FlightError(f"{role}, frame {number}: {found}", {"frames": [frame.hex() for frame in batch]})
    await asyncio.sleep(ANSWERED_S)
    return {
        "frames": FRAMES,
        "seconds": round(monotonic() - began, 1),
        "messages": len(frames.by_message),
        "farthest_m": round(farthest_m, 2),
    }


async def _send(world: World, pilot: Pilot, frames: RoleFrames) -> list[bytes]:
    """Send some frames, and wait until the autopilot has read them: it answers a TIMESYNC after them."""
    station, batch = world.station, [frames.draw() for _ in range(BATCH)]
    for frame in batch:
        await world.vehicles[0].tap.send(frame)
    token = monotonic_ns()
    with station.inbox(pilot.system, "TIMESYNC") as inbox:
        for _ in range(TRIES):
            station.send(mavlink.MAVLink_timesync_message(0, token))
            ends_at = monotonic() + 1.0
            while (left_s := ends_at - monotonic()) > 0 and (answer := await inbox.next(left_s)) is not None:
                if answer.tc1 and answer.ts1 == token:
                    return batch
    raise FlightError(f"{frames.role}: no answer, it may have ended", {"frames": [frame.hex() for frame in batch]})


async def _lose_station(world: World, pilot: Pilot, role: str) -> None:
    """Frames of other members do not suppress the failsafe for a lost ground station."""
    station, frames = world.station, RoleFrames(role, SEED)
    await pilot.set_parameters(pilot.kind.failsafe)
    await pilot.set_mode(Mode.GUIDED)
    station.beats = False
    ends_at = monotonic() + FAILSAFE_S
    while station.mode(pilot.system) != pilot.kind.modes[Mode.RETURN]:
        if monotonic() > ends_at:
            raise FlightError(f"{role}: the failsafe did not trip", {})
        await _send(world, pilot, frames)
    seen, station.beats = len(station.texts), True  # heard before the next silence: each trips once
    await station.until(
        lambda: any("Failsafe Cleared" in text for _, _, text in station.texts[seen:]),
        FAILSAFE_S,
        "the end of the failsafe",
    )


async def steady(station: Station, pilot: Pilot) -> Snapshot:
    """Wait until nothing changes by itself from one snapshot to the next: neither home and origin nor the streams."""
    before, changes = await snapshot(station, pilot), [""]
    for _ in range(STEADY_TRIES):
        after = await snapshot(station, pilot)
        if not (changes := differences(before, after)):
            return after
        before = after
    raise FlightError(f"not steady: {'; '.join(changes)}", {})


async def snapshot(station: Station, pilot: Pilot) -> Snapshot:
    """Ask the autopilot for its whole state."""
    system, first = pilot.system, len(station.received)
    await asyncio.sleep(RATE_WINDOW_S)
    count = Counter(name_of(passing.frame) for passing in station.received[first:])
    parameters = await download_parameters(station, system)
    exact: dict[str, object] = {"armed": station.is_armed(system), "mode": station.mode(system)}
    # As bytes: PX4 carries integers in those of a float, which may be NaN.
    exact |= {name: struct.pack("<f", value) for name, value in parameters.items() if name not in COUNTERS}
    exact |= {f"plan {plan}": repr(await download_mission(station, system, plan=plan)) for plan in PLANS}
    clock = None if pilot.kind.is_px4 else await _requested(station, system, "SYSTEM_TIME")
    return Snapshot(
        exact,
        {name: _place_of(await _requested(station, system, name)) for name in LIMITS_M},
        None if clock is None else clock.time_unix_usec / 1e6 - clock.time_boot_ms / 1e3,
        {name: number / RATE_WINDOW_S for name, number in count.items() if name not in NO_STREAMS},
    )


async def _requested(station: Station, system: int, name: str) -> Any:
    """A message; None if the autopilot does not have it."""
    number = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    with station.inbox(system, name) as inbox:
        result = await station.command(system, mavlink.MAV_CMD_REQUEST_MESSAGE, number)
        return await inbox.next(2.0) if result == mavlink.MAV_RESULT_ACCEPTED else None


def _place_of(message: Any) -> Place | None:
    if message is None:
        return None
    if message.get_type() == "POSITION_TARGET_GLOBAL_INT":
        return Place(message.lat_int, message.lon_int, message.alt)
    return Place(message.latitude, message.longitude, message.altitude / 1000)


def differences(before: Snapshot, after: Snapshot) -> list[str]:
    """What changed from one snapshot to the other. One message in the window of rates may be a coincidence."""
    changes = [
        f"{name}: {before.exact.get(name)!r} became {after.exact.get(name)!r}"
        for name in sorted(before.exact.keys() | after.exact.keys())
        if before.exact.get(name) != after.exact.get(name)
    ]
    for name, limit_m in LIMITS_M.items():
        old, new = before.places[name], after.places[name]
        if (old is None) != (new is None) or (old and new and _apart_m(old, new) > limit_m):
            changes.append(f"{name}: {old} became {new}")
    if before.clock_s is not None and after.clock_s is not None and abs(before.clock_s - after.clock_s) > CLOCK_S:
        changes.append(f"clock: jumped by {after.clock_s - before.clock_s:.1f} s")
    for name in sorted(before.rates.keys() | after.rates.keys()):
        old_rate, new_rate = before.rates.get(name, 0.0), after.rates.get(name, 0.0)
        if abs(old_rate - new_rate) > max(RATE_SHARE * max(old_rate, new_rate), 3 / RATE_WINDOW_S):
            changes.append(f"rate of {name}: {old_rate:.2f}/s became {new_rate:.2f}/s")
    return changes


def _apart_m(one: Place, other: Place) -> float:
    """Metres between two places; infinite if the height of only one is a number."""
    if math.isnan(one.z) != math.isnan(other.z):
        return math.inf
    return math.hypot(one.distance_m(other), 0.0 if math.isnan(one.z) else one.z - other.z)


def _plans(pilot: Pilot) -> Mapping[int, list[Item]]:
    """A mission, a fence around the vehicle and one rally point."""
    start, frame = pilot.place, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    vertex, rally = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, mavlink.MAV_CMD_NAV_RALLY_POINT
    corners = [start.moved(north, east, 0.0) for north, east in ((-220, -220), (-220, 220), (220, 220), (220, -220))]
    shelter = start.moved(11, 11, 20.0)
    mission, fence, shelters = PLANS
    return {
        mission: pilot.mission(start.moved(33, 0, 25.0), start.moved(33, 33, 30.0)),
        fence: [Item(vertex, frame, (4, 0, 0, 0), corner.x, corner.y, corner.z) for corner in corners],
        shelters: [Item(rally, frame, (0, 0, 0, 0), shelter.x, shelter.y, shelter.z)],
    }
