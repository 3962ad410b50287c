"""How the simulated copter moves: where it ends, how fast it gets there, what it never does."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.lab.sim.vehicle import Axes, GeoPoint, Landed, Mode, Vehicle

HOME = GeoPoint(47.4, 8.5, 488.0)


def in_the_air(altitude_m: float = 10.0) -> Vehicle:
    vehicle = Vehicle(HOME, mode=Mode.GUIDED)
    vehicle.arm()
    vehicle.take_off(altitude_m)
    for _ in range(200):
        vehicle.step(0.1)
    assert vehicle.landed is Landed.IN_AIR
    return vehicle


@settings(max_examples=8)  # each example is a flight of minutes
@given(
    north=st.floats(-300, 300),
    east=st.floats(-300, 300),
    up=st.floats(0.5, 50),
    step_s=st.sampled_from([0.05, 0.1, 1.0]),
)
def test_it_arrives_and_stays(north: float, east: float, up: float, step_s: float) -> None:
    """Any target is reached without passing the speeds allowed, and held."""
    vehicle = in_the_air()
    vehicle.go_to(Axes(north, east, up))
    # The slowest way there: along at 8 m/s and down at 1.5 m/s, with time to speed up, brake and settle.
    needed_s = math.hypot(north, east) / 8 + abs(up - 10) / 1.5 + 20
    for _ in range(int(needed_s / step_s) + 1):
        vehicle.step(step_s)
        assert vehicle.ground_speed_m_s <= vehicle.speeds.travel_m_s + 0.01
        assert -vehicle.speeds.descend_m_s - 0.01 <= vehicle.velocity.up <= vehicle.speeds.climb_m_s + 0.01
    assert vehicle.has_arrived(within_m=0.5)
    assert vehicle.ground_speed_m_s < 0.5


@given(st.floats(-85, 85), st.floats(-180, 179.9), st.floats(-3000, 3000), st.floats(-3000, 3000))
def test_a_place_and_its_point_belong_together(latitude: float, longitude: float, north: float, east: float) -> None:
    """From metres to degrees and back is the same point, also over the 180th meridian."""
    vehicle = Vehicle(GeoPoint(latitude, longitude, 100.0))
    point = vehicle.point_of(vehicle.place_of(Axes(north, east, 25.0)))
    assert (point.north, point.east, point.up) == pytest.approx((north, east, 25.0), abs=1e-3)
