"""Flying an autopilot from the station: modes, arming, take-off, guided waypoints, a mission, return."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from time import monotonic

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.station import AUTOPILOT, RequestError, Station
from tests.sitl.tables import Item, upload_mission

HEIGHT_M = 10.0
STREAM_RATE_HZ = 10
NEAR_M = 3.0
METRE = 1e7 / 111_319.5
"""Of latitude, in 1e-7 degrees."""
LEG_S = 120.0
LAND_S = 300.0
READY_S = 180.0
MODE_S = 5.0
PX4_AUTO = 4
RELATIVE = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT


class Mode(StrEnum):
    """What the scenarios ask for. Autopilots have other names and numbers for it."""

    GUIDED = "guided"
    MISSION = "mission"
    RETURN = "return"


@dataclass(frozen=True, slots=True)
class Kind:
    """How one kind of autopilot is flown."""

    name: str
    modes: Mapping[Mode, int]
    """The custom mode in HEARTBEAT."""
    is_px4: bool = False
    has_home_item: bool = True
    """Item 0 of a mission is the home position."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Parameters from the start."""
    failsafe: Mapping[str, float] = field(default_factory=dict)
    """Parameters that make the vehicle return without its ground station."""
    failsafe_s: float = 5.0
    """The time from the last heartbeat until it returns."""


def _px4(sub_mode: int) -> int:
    return PX4_AUTO << 16 | sub_mode << 24


_COPTER_MODES = {Mode.GUIDED: 4, Mode.MISSION: 3, Mode.RETURN: 6}
COPTER = Kind(
    "ArduCopter",
    _COPTER_MODES,
    # SITL ends itself where a number that is not finite becomes an integer. A flight controller goes on.
    parameters={"SIM_FLOAT_EXCEPT": 0},
    failsafe={"FS_GCS_ENABLE": 1, "FS_GCS_TIMEOUT": 5},
)
PX4 = Kind(
    "PX4",
    {Mode.GUIDED: _px4(3), Mode.MISSION: _px4(4), Mode.RETURN: _px4(5)},
    is_px4=True,
    has_home_item=False,
    parameters={"SDLOG_MODE": 0},  # a log from arming to disarming
    failsafe={"NAV_DLL_ACT": 2, "COM_DL_LOSS_T": 5, "COM_FAIL_ACT_T": 0.0},
    failsafe_s=7.5,  # it notices a lost heartbeat after 2.5 s, then waits 5 s
)
OWN = Kind("uavlinkd sim", _COPTER_MODES)


@dataclass(frozen=True, slots=True)
class Place:
    """A point: latitude and longitude in 1e-7 degrees, metres above home."""

    x: int
    y: int
    z: float

    def moved(self, north_m: float, east_m: float, z: float | None = None) -> Place:
        """A point north and east of this one."""
        east = east_m * METRE / math.cos(math.radians(self.x / 1e7))
        return Place(round(self.x + north_m * METRE), round(self.y + east), self.z if z is None else z)

    def distance_m(self, other: Place) -> float:
        """The distance over ground."""
        north = (other.x - self.x) / METRE
        east = (other.y - self.y) / METRE * math.cos(math.radians(self.x / 1e7))
        return math.hypot(north, east)


def wire_value(value: float) -> tuple[float, int]:
    """A parameter of PX4 as PARAM_SET carries it: an integer's bytes are in the float. Value and type."""
    if isinstance(value, int):
        return struct.unpack("<f", struct.pack("<i", value))[0], mavlink.MAV_PARAM_TYPE_INT32
    return value, mavlink.MAV_PARAM_TYPE_REAL32


class Pilot:
    """One vehicle, flown from the station."""

    def __init__(self, station: Station, system: int, kind: Kind) -> None:
        self.station = station
        self.system = system
        self.kind = kind

    @property
    def place(self) -> Place:
        """The newest position that the station received."""
        position = self.station.position(self.system)
        assert position is not None, "no position was received"
        return Place(*position)

    async def request_streams(self) -> None:
        """Request telemetry until positions arrive. ArduPilot sends almost nothing by itself."""
        for _ in range(30):
            self.station.send(
                mavlink.MAVLink_request_data_stream_message(self.system, AUTOPILOT, 0, STREAM_RATE_HZ, 1)
            )
            try:
                with self.station.inbox(self.system, "GLOBAL_POSITION_INT") as inbox:
                    if await inbox.next(2.0) is not None:
                        return
            except RequestError:
                continue
        raise RequestError("no position was received")

    async def set_parameters(self, parameters: Mapping[str, float]) -> None:
        """Set parameters, and wait until the vehicle reports each."""
        for name, value in parameters.items():
            number, kind = wire_value(value) if self.kind.is_px4 else (float(value), mavlink.MAV_PARAM_TYPE_REAL32)
            await self.station.set_parameter(self.system, name, number, kind)

    async def set_mode(self, mode: Mode, timeout_s: float = 60.0) -> None:
        """Change the mode, and wait until the heartbeat says so."""
        custom = self.kind.modes[mode]
        parameters = (PX4_AUTO, custom >> 24) if self.kind.is_px4 else (custom,)
        deadline = monotonic() + timeout_s
        while monotonic() < deadline:
            await self.station.must(self.system, mavlink.MAV_CMD_DO_SET_MODE, 1, *parameters, timeout_s=timeout_s)
            # PX4 accepts the command, and may then report that the mission is not available yet.
            with suppress(RequestError):
                await self.station.until(lambda: self.station.mode(self.system) == custom, MODE_S, f"mode {mode}")
                return
        raise RequestError(f"mode {mode}: not within {timeout_s:.0f} s; texts: {self.station.texts[-5:]}")

    async def take_off(self, height_m: float = HEIGHT_M) -> None:
        """Arm as soon as the vehicle is ready, take off, and wait until it is there."""
        station, system = self.station, self.system
        await self.until_ready()
        if not self.kind.is_px4:  # not before: it reads the switch of the radio control after its start
            await self.set_mode(Mode.GUIDED)
        altitude_m, anywhere = height_m, 0.0
        if self.kind.is_px4:
            position = station.latest[system, "GLOBAL_POSITION_INT"]
            altitude_m, anywhere = position.alt / 1000 + height_m, math.nan
        arm = (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        climb = (mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, anywhere, anywhere, anywhere, altitude_m)
        # PX4 arms in the mode of a take-off, ArduPilot takes off only once it is armed.
        commands = (climb, arm) if self.kind.is_px4 else (arm, climb)
        for command in commands:
            await station.must(system, *command, timeout_s=READY_S)
        await station.until(lambda: station.is_armed(system), LEG_S, "armed")
        await station.until(lambda: self.place.z > 0.9 * height_m, LEG_S, f"{height_m} m above home")

    async def until_ready(self) -> None:
        """Wait until the vehicle may be armed."""
        await self.station.until(self._is_ready, READY_S, "ready to arm")

    def _is_ready(self) -> bool:
        """Whether the vehicle knows its position, and its checks before arming pass."""
        latest, system = self.station.latest, self.system
        status, estimate = latest.get((system, "SYS_STATUS")), latest.get((system, "EKF_STATUS_REPORT"))
        if (system, "GLOBAL_POSITION_INT") not in latest:
            return False
        if self.kind is OWN:
            return True
        if not self.kind.is_px4 and (estimate is None or not estimate.flags & mavlink.EKF_POS_HORIZ_ABS):
            return False
        return status is not None and bool(
            status.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK
        )

    async def go_to(self, place: Place) -> None:
        """Fly to a guided waypoint."""
        frame, z = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, place.z
        if self.kind.is_px4:  # it expects metres above sea level here
            position = self.station.latest[self.system, "GLOBAL_POSITION_INT"]
            frame, z = mavlink.MAV_FRAME_GLOBAL, place.z + (position.alt - position.relative_alt) / 1000
        result = await self.station.command_at(
            self.system, mavlink.MAV_CMD_DO_REPOSITION, frame, (-1, 1, 0, math.nan), (place.x, place.y, z)
        )
        if result != mavlink.MAV_RESULT_ACCEPTED:
            raise RequestError(f"the waypoint was refused with {result}; texts: {self.station.texts[-5:]}")
        await self.until_at(place)

    async def until_at(self, place: Place, timeout_s: float = LEG_S) -> None:
        """Wait until the vehicle is near a point."""
        await self.station.until(
            lambda: self.place.distance_m(place) < NEAR_M, timeout_s, f"within {NEAR_M} m of {place}"
        )

    def mission(self, *places: Place) -> list[Item]:
        """A mission through points, with the home position before it if the autopilot expects one."""
        waypoint = mavlink.MAV_CMD_NAV_WAYPOINT
        items = [Item(waypoint, RELATIVE, (0, 0, 0, 0), place.x, place.y, place.z) for place in places]
        return [items[0], *items] if self.kind.has_home_item else items

    async def fly_mission(self, *places: Place) -> None:
        """Upload a mission through points, and fly it to the last."""
        await upload_mission(self.station, self.system, self.mission(*places))
        await self.set_mode(Mode.MISSION)
        for place in places:
            await self.until_at(place)

    async def return_and_land(self) -> None:
        """Return home, land, and wait until the motors stop."""
        await self.set_mode(Mode.RETURN)
        await self.station.until(lambda: not self.station.is_armed(self.system), LAND_S, "landed and disarmed")
