"""The motion of the simulated copter: speeds and accelerations, without aerodynamics."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

# A longer step is divided, so that the copter does not jump through the ground after the process stalls.
MAX_STEP_S: Final = 0.1
# After a longer pause the model does not catch up: the process was suspended.
MAX_CATCH_UP_S: Final = 5.0

ACCELERATION_M_S2: Final = 2.5
EARTH_RADIUS_M: Final = 6_378_137.0


class Mode(IntEnum):
    """Flight modes, with ArduCopter's custom_mode numbers."""

    STABILIZE = 0
    GUIDED = 4
    LOITER = 5
    RTL = 6
    LAND = 9


class Landed(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


@dataclass(frozen=True, slots=True)
class GeoPoint:
    """A point on the globe: degrees (WGS 84) and metres above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


@dataclass(slots=True)
class Axes:
    """A vector north, east and up: metres from home, or metres per second."""

    north: float = 0.0
    east: float = 0.0
    up: float = 0.0


@dataclass(slots=True)
class Speeds:
    """The speed limits of the vehicle."""

    climb_m_s: float = 2.5
    descend_m_s: float = 1.5
    land_m_s: float = 1.0
    travel_m_s: float = 8.0


@dataclass(slots=True)
class Vehicle:
    """The state of the copter: position, target, heading.

    ``arm``, ``disarm``, ``take_off``, ``go_to`` and ``set_mode`` control it, and ``step`` moves it. Positions are
    relative to home, where it starts on the ground.
    """

    home: GeoPoint
    speeds: Speeds = field(default_factory=Speeds)
    return_altitude_m: float = 15.0
    mode: Mode = Mode.STABILIZE
    armed: bool = False
    landed: Landed = Landed.ON_GROUND
    position: Axes = field(default_factory=Axes)
    velocity: Axes = field(default_factory=Axes)
    target: Axes = field(default_factory=Axes)
    yaw_rad: float = 0.0

    @property
    def altitude_m(self) -> float:
        return self.position.up

    @property
    def place(self) -> GeoPoint:
        return self.place_of(self.position)

    @property
    def ground_speed_m_s(self) -> float:
        return math.hypot(self.velocity.north, self.velocity.east)

    def place_of(self, point: Axes) -> GeoPoint:
        """A point relative to home, on the globe."""
        per_degree = math.radians(1) * EARTH_RADIUS_M
        latitude = self.home.latitude_deg + point.north / per_degree
        longitude = self.home.longitude_deg + point.east / (per_degree * self._meridians_close())
        return GeoPoint(latitude, (longitude + 180) % 360 - 180, self.home.altitude_m + point.up)

    def point_of(self, place: GeoPoint) -> Axes:
        """A point on the globe, relative to home."""
        per_degree = math.radians(1) * EARTH_RADIUS_M
        east_deg = (place.longitude_deg - self.home.longitude_deg + 180) % 360 - 180
        return Axes(
            (place.latitude_deg - self.home.latitude_deg) * per_degree,
            east_deg * per_degree * self._meridians_close(),
            place.altitude_m - self.home.altitude_m,
        )

    def arm(self) -> None:
        self.armed = True
        self.target = Axes(self.position.north, self.position.east, self.position.up)

    def disarm(self) -> None:
        """Stop the motors; in the air, the copter drops to the ground."""
        self.armed = False
        self._touch_down()

    def set_mode(self, mode: Mode) -> None:
        """Change the flight mode: LAND lands here, RTL at home, the others hold the position."""
        self.mode = mode
        if self.landed is Landed.ON_GROUND:
            return
        here = self.position
        if mode is Mode.LAND:
            self.land()
        elif mode is Mode.RTL:
            self.target = Axes(0.0, 0.0, max(here.up, self.return_altitude_m))
            self.landed = Landed.IN_AIR
        else:
            self.target = Axes(here.north, here.east, here.up)
            self.landed = Landed.IN_AIR

    def take_off(self, altitude_m: float) -> None:
        """Climb vertically to an altitude above home. Only when armed."""
        self.target = Axes(self.position.north, self.position.east, altitude_m)
        if self.landed is Landed.ON_GROUND:
            self.landed = Landed.TAKEOFF

    def land(self) -> None:
        """Descend vertically; on the ground, the motors stop. Only when in the air."""
        self.target = Axes(self.position.north, self.position.east, 0.0)
        self.landed = Landed.LANDING

    def go_to(self, point: Axes) -> None:
        """Fly to a point relative to home. Only when in the air."""
        self.target = Axes(point.north, point.east, max(point.up, 0.5))

    def has_arrived(self, within_m: float = 1.0) -> bool:
        return math.dist(
            (self.position.north, self.position.east, self.position.up),
            (self.target.north, self.target.east, self.target.up),
        ) <= max(within_m, 0.1)

    def step(self, duration_s: float) -> None:
        left = min(max(duration_s, 0.0), MAX_CATCH_UP_S)
        while left > 0:
            step_s = min(left, MAX_STEP_S)
            self._step(step_s)
            left -= step_s

    def _step(self, step_s: float) -> None:
        if not self.armed or self.landed is Landed.ON_GROUND:
            return
        if self.mode is Mode.RTL and self.landed is Landed.IN_AIR and self.has_arrived():
            self.target = Axes(0.0, 0.0, 0.0)
            self.landed = Landed.LANDING
        self._accelerate(self._wanted_velocity(), step_s)
        self.position.north += self.velocity.north * step_s
        self.position.east += self.velocity.east * step_s
        self.position.up += self.velocity.up * step_s
        if self.ground_speed_m_s > 0.5:
            self.yaw_rad = math.atan2(self.velocity.east, self.velocity.north)
        if self.landed is Landed.TAKEOFF and self.position.up > 0.9 * self.target.up:
            self.landed = Landed.IN_AIR
        if self.landed is Landed.LANDING and self.position.up <= 0.05:
            self._touch_down()
            self.armed = False
        self.position.up = max(self.position.up, 0.0)

    def _wanted_velocity(self) -> Axes:
        """The velocity towards the target, decelerating to stop there."""
        north, east = self.target.north - self.position.north, self.target.east - self.position.east
        distance = math.hypot(north, east)
        # The factor 0.8 allows for the length of a step.
        speed = min(self.speeds.travel_m_s, 0.8 * math.sqrt(2 * ACCELERATION_M_S2 * distance), 2 * distance)
        if self.landed is Landed.LANDING:
            vertical = -self.speeds.land_m_s  # until the ground, without a hover above it
        else:
            up = self.target.up - self.position.up
            vertical = max(-self.speeds.descend_m_s, min(self.speeds.climb_m_s, 1.5 * up))
        if distance < 1e-6:
            return Axes(0.0, 0.0, vertical)
        return Axes(speed * north / distance, speed * east / distance, vertical)

    def _accelerate(self, wanted: Axes, step_s: float) -> None:
        most = ACCELERATION_M_S2 * step_s
        north, east = wanted.north - self.velocity.north, wanted.east - self.velocity.east
        change = math.hypot(north, east)
        share = 1.0 if change <= most else most / change
        self.velocity.north += north * share
        self.velocity.east += east * share
        self.velocity.up += max(-most, min(most, wanted.up - self.velocity.up))

    def _touch_down(self) -> None:
        self.position.up = 0.0
        self.velocity = Axes()
        self.landed = Landed.ON_GROUND

    def _meridians_close(self) -> float:
        # Not zero at a pole, where longitude is undefined.
        return max(math.cos(math.radians(self.home.latitude_deg)), 1e-6)
