"""What vehicles report of themselves, as pymavlink writes it and the status shows it."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.frames import Frame, SplitCounters, split_datagram
from uavlinkd.mavlink.vehicles import BATTERY_S, MOST_VEHICLES, Vehicles


def sent(message: mavlink.MAVLink_message, system: int = 7, component: int = 1, *, old: bool = False) -> Frame:
    """The frame of a message; ``old``: in MAVLink 1."""
    mav = mavlink.MAVLink(None, system, component)
    (frame,) = split_datagram(message.pack(mav, force_mavlink1=old), SplitCounters())
    return frame


def heartbeat(mode: int = 5, base: int = 209, kind: int = mavlink.MAV_TYPE_QUADROTOR) -> mavlink.MAVLink_message:
    return mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, base, mode, 4, 3)


def battery(millivolts: int, percent: int) -> mavlink.MAVLink_message:
    return mavlink.MAVLink_sys_status_message(1, 2, 3, 500, millivolts, -1, percent, 4, 5, 6, 7, 8, 9)


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("percent", [0, 80, 100])
def test_a_vehicle_has_mode_and_battery(percent: int, old: bool) -> None:
    """In MAVLink 2 zeros at the payload's end are cut off."""
    vehicles = Vehicles()
    vehicles.note(sent(heartbeat(), old=old), 1.0)
    vehicles.note(sent(battery(16_000, percent), old=old), 2.0)
    facts = {"system": 7, "heartbeat_s": 3.0, "type": 2, "autopilot": 3, "is_armed": True, "custom_mode": 5}
    assert vehicles.status(4.0) == [facts | {"battery_v": 16.0, "battery_percent": percent}]


def test_the_last_report_counts_and_an_old_one_says_nothing_about_the_battery() -> None:
    vehicles = Vehicles()
    vehicles.note(sent(battery(65_535, -1)), 1.0)
    assert vehicles.status(1.0) == []
    vehicles.note(sent(heartbeat(mode=4, base=81)), 1.0)
    vehicles.note(sent(heartbeat(mode=6, base=81)), 1.0)
    (vehicle,) = vehicles.status(1.0)
    assert (vehicle["is_armed"], vehicle["custom_mode"]) == (False, 6)
    assert (vehicle["battery_v"], vehicle["battery_percent"]) == (None, None)
    vehicles.note(sent(battery(15_000, 50)), 2.0)
    assert [vehicles.status(2 + age)[0]["battery_percent"] for age in (BATTERY_S - 0.1, BATTERY_S)] == [50, None]


def test_a_ground_station_and_a_camera_are_no_vehicles() -> None:
    vehicles = Vehicles()
    vehicles.note(sent(heartbeat(kind=mavlink.MAV_TYPE_GCS)), 1.0)
    vehicles.note(sent(heartbeat(), component=mavlink.MAV_COMP_ID_CAMERA), 1.0)
    assert vehicles.status(1.0) == []


def test_a_peer_that_invents_systems_displaces_its_own() -> None:
    """The memory is bounded."""
    vehicles = Vehicles()
    for system in range(1, 100):
        vehicles.note(sent(heartbeat(), system=system), 1.0)
    assert [one["system"] for one in vehicles.status(1.0)] == list(range(100 - MOST_VEHICLES, 100))
