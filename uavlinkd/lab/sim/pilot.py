"""Flies the mission in AUTO: takes off, visits waypoints, lands or returns."""

from __future__ import annotations

from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.mission import LOCAL_FRAMES, Item, Missions
from uavlinkd.lab.sim.vehicle import Axes, GeoPoint, Landed, Mode, Vehicle

ABSOLUTE_FRAMES: Final = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
# A copter flies to each of these.
WAYPOINTS: Final = (
    mavlink.MAV_CMD_NAV_WAYPOINT,
    mavlink.MAV_CMD_NAV_SPLINE_WAYPOINT,
    mavlink.MAV_CMD_NAV_LOITER_TIME,
    mavlink.MAV_CMD_NAV_LOITER_UNLIM,
)


def point_of(vehicle: Vehicle, frame: int, x: int, y: int, z: float) -> Axes:
    """The target of an item or a command, relative to home. Zero x and y mean the vehicle's position."""
    if frame in LOCAL_FRAMES:
        up = z if frame == mavlink.MAV_FRAME_LOCAL_ENU else -z
        return Axes(x / 1e4, y / 1e4, up)
    altitude = z if frame in ABSOLUTE_FRAMES else vehicle.home.altitude_m + z
    if x == 0 and y == 0:
        return Axes(vehicle.position.north, vehicle.position.east, altitude - vehicle.home.altitude_m)
    return vehicle.point_of(GeoPoint(x / 1e7, y / 1e7, altitude))


class MissionPilot:
    """Follows the plan while the mode is AUTO. As in ArduPilot, item 0 is home and not a waypoint."""

    def __init__(self, vehicle: Vehicle, missions: Missions) -> None:
        self._vehicle = vehicle
        self._missions = missions
        self._begun: int | None = None

    def restart(self) -> None:
        """Start the current item again, after a change of the mode, the plan or the current item."""
        self._begun = None

    def advance(self) -> list[int]:
        """Continue the mission, and return the reached items."""
        vehicle, missions = self._vehicle, self._missions
        reached: list[int] = []
        # If all items are skipped, the loop ends at the last one.
        while vehicle.armed and vehicle.mode is Mode.AUTO and missions.plan:
            sequence = missions.current
            if self._begun != sequence:
                self._begun = sequence
                self._begin(sequence, missions.plan[sequence])
            if not self._is_done(sequence, missions.plan[sequence]):
                break
            if sequence > 0:
                reached.append(sequence)
            if not missions.set_current(sequence + 1) and vehicle.mode is Mode.AUTO:
                # The end of the plan: hold the position, unless the last item was to return or land.
                vehicle.set_mode(Mode.LOITER)
        return reached

    def _begin(self, sequence: int, item: Item) -> None:
        vehicle = self._vehicle
        if sequence == 0:
            return
        point = point_of(vehicle, item.frame, item.x, item.y, item.z)
        if item.command == mavlink.MAV_CMD_NAV_TAKEOFF:
            vehicle.take_off(max(point.up, 0.5))
        elif vehicle.landed is Landed.ON_GROUND:
            return
        elif item.command in WAYPOINTS:
            vehicle.go_to(point)
        elif item.command == mavlink.MAV_CMD_NAV_LAND:
            vehicle.land()
        elif item.command == mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
            vehicle.set_mode(Mode.RTL)

    def _is_done(self, sequence: int, item: Item) -> bool:
        if sequence == 0 or item.command not in (*WAYPOINTS, mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_LAND):
            return True
        # As in ArduCopter, a waypoint without a take-off before it never starts.
        if item.command == mavlink.MAV_CMD_NAV_LAND:
            return self._vehicle.landed is Landed.ON_GROUND
        return self._vehicle.landed is not Landed.ON_GROUND and self._vehicle.has_arrived()
