"""The simulated autopilot towards ground stations, without a network: answers, flight, failsafe, hostile bytes."""

from __future__ import annotations

import itertools
import math
import random
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import Station, decode, of_type
from uavlinkd.lab.sim.autopilot import Autopilot, AutopilotSettings
from uavlinkd.lab.sim.vehicle import Landed, Mode

ACCEPTED, DENIED, FAILED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_FAILED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED


def station(**settings: Any) -> Station:
    """A ground station beside a fresh copter."""
    return Station(Autopilot(AutopilotSettings(**settings)))


def armed_and_landed(here: Station) -> tuple[bool, Landed]:
    """What the copter is doing."""
    return here.autopilot.vehicle.armed, here.autopilot.vehicle.landed


def mode(here: Station) -> Mode:
    """What the copter is flying in."""
    return here.autopilot.vehicle.mode


def test_telemetry_comes_at_its_rates() -> None:
    """A new copter sends each message at the rate of its settings."""
    received = station(attitude_rate_hz=50, position_rate_hz=4).wait(10.0)
    counts = {
        name: len(of_type(received, name)) for name in ("HEARTBEAT", "ATTITUDE", "GLOBAL_POSITION_INT", "SYS_STATUS")
    }
    assert {name: pytest.approx(count, abs=2) for name, count in counts.items()} == {
        "HEARTBEAT": 10,
        "ATTITUDE": 500,
        "GLOBAL_POSITION_INT": 40,
        "SYS_STATUS": 10,
    }


def test_frames_are_numbered_without_gaps() -> None:
    """The sequence runs over all that one copter sends, and over its end at 255."""
    numbers = [message.get_seq() for message in station(attitude_rate_hz=100).wait(5.0)]
    assert len(numbers) > 256
    assert all((after - before) % 256 == 1 for before, after in itertools.pairwise(numbers))


def test_its_ids_are_in_every_frame() -> None:
    """Every frame has the system and component of the settings."""
    received = station(system_id=42, component_id=7).wait(2.0)
    assert {(message.get_srcSystem(), message.get_srcComponent()) for message in received} == {(42, 7)}


def test_equal_seed_and_input_give_equal_frames() -> None:
    """Settings, input and time determine all frames."""

    def flight(seed: int) -> list[bytes]:
        autopilot = Autopilot(AutopilotSettings(seed=seed), unix_epoch_us=10**15)
        here = Station(autopilot)
        frames = list(autopilot.receive(here.encode(mavlink.MAVLink_param_request_list_message(1, 1)), 0.0))
        for step in range(100):
            frames += autopilot.advance(step * 0.1)
        return frames

    assert flight(1) == flight(1)
    assert flight(1) != flight(2)


@pytest.mark.parametrize(
    "wrong",
    [
        {"system_id": 0},
        {"system_id": 256},
        {"component_id": 0},
        {"attitude_rate_hz": -1.0},
        {"attitude_rate_hz": 1001.0},
        {"position_rate_hz": math.nan},
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, Any]) -> None:
    """Ids are 1 to 255 and rates 0 to 1000, and the error names the setting."""
    with pytest.raises(ValueError, match=next(iter(wrong))):
        AutopilotSettings(**wrong)


def test_it_arms_takes_off_lands_and_disarms() -> None:
    """A flight in GUIDED has the landed states in order, and reaches its altitude."""
    here = station()
    assert here.result(mavlink.MAV_CMD_DO_SET_MODE, 1, 4) == ACCEPTED
    assert here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED
    assert here.result(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 8) == ACCEPTED
    up = here.wait(12)
    assert here.autopilot.vehicle.altitude_m == pytest.approx(8, abs=0.3)
    assert here.result(mavlink.MAV_CMD_NAV_LAND) == ACCEPTED
    down = here.wait(14)
    states = [message.landed_state for message in of_type(up + down, "EXTENDED_SYS_STATE")]
    assert [state for state, _ in itertools.groupby(states)] == [3, 2, 4, 1]
    last = of_type(down, "HEARTBEAT")[-1]
    assert not last.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    assert last.custom_mode == Mode.LAND
    assert [here.autopilot.counters.events[name] for name in ("armed", "takeoff_started", "landed", "disarmed")] == [
        1
    ] * 4


@pytest.mark.parametrize(
    ("number", "parameters", "result"),
    [
        (mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, 5), FAILED),  # not armed
        (mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, math.nan), DENIED),
        (mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, -1), DENIED),
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (math.nan,), DENIED),
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (2,), DENIED),
        (mavlink.MAV_CMD_DO_SET_MODE, (1, math.inf), DENIED),
        (mavlink.MAV_CMD_DO_SET_MODE, (1, 77), DENIED),
        (mavlink.MAV_CMD_DO_SET_MODE, (1, Mode.AUTO), FAILED),  # without a mission
        (mavlink.MAV_CMD_MISSION_START, (), FAILED),
        (mavlink.MAV_CMD_DO_REPOSITION, (), FAILED),
        (mavlink.MAV_CMD_DO_CHANGE_SPEED, (0, -3), DENIED),
        (mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, (9,), DENIED),
        (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (mavlink.MAVLINK_MSG_ID_HEARTBEAT, -1), FAILED),
        (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (math.nan, 1000), DENIED),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (4711,), UNSUPPORTED),
        (mavlink.MAV_CMD_PREFLIGHT_STORAGE, (1,), UNSUPPORTED),
        (65535, (), UNSUPPORTED),
    ],
)
def test_a_command_that_cannot_be_done_says_so(number: int, parameters: tuple[float, ...], result: int) -> None:
    """Every command is acknowledged, and a failed one changes nothing."""
    here = station()
    assert here.result(number, *parameters) == result
    assert not here.autopilot.vehicle.armed
    assert mode(here) is Mode.STABILIZE


def test_disarming_in_the_air_takes_force() -> None:
    """Motors stop in flight only with the number that overrides the checks."""
    here = station()
    here.take_off()
    assert here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0) == FAILED
    assert armed_and_landed(here) == (True, Landed.IN_AIR)
    assert here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == ACCEPTED
    assert armed_and_landed(here) == (False, Landed.ON_GROUND)


def test_a_command_int_counts_as_a_command_long() -> None:
    """A take-off to an altitude above mean sea level subtracts that of home."""
    here = station()
    here.result(mavlink.MAV_CMD_DO_SET_MODE, 1, 4)
    here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    sea = here.autopilot.settings.home.altitude_m
    message = mavlink.MAVLink_command_int_message(
        1, 1, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 0, 0, sea + 6
    )
    assert here.tell(message)[-1].result == ACCEPTED
    here.wait(10)
    assert here.autopilot.vehicle.altitude_m == pytest.approx(6, abs=0.3)


def test_set_mode_is_acknowledged() -> None:
    """The old SET_MODE message works as the command does."""
    here = station()
    answer = here.tell(mavlink.MAVLink_set_mode_message(1, 1, Mode.LOITER))[-1]
    assert (answer.command, answer.result) == (mavlink.MAVLINK_MSG_ID_SET_MODE, ACCEPTED)
    assert mode(here) is Mode.LOITER


def test_acknowledgements_name_who_asked() -> None:
    """Each of several stations can identify its own acknowledgement."""
    autopilot = Autopilot()
    for ids in ((255, 190), (250, 1)):
        acknowledgement = Station(autopilot, *ids).command(mavlink.MAV_CMD_NAV_LAND)[-1]
        assert (acknowledgement.target_system, acknowledgement.target_component) == ids


@pytest.mark.parametrize("target", [(2, 1), (2, 0), (1, 100)])
def test_what_is_meant_for_others_is_left_to_them(target: tuple[int, int]) -> None:
    """A command for another target is neither executed nor answered."""
    here = station()
    assert here.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, target=target) == []
    assert not here.autopilot.vehicle.armed
    assert here.autopilot.counters.for_others == 1


@pytest.mark.parametrize("target", [(0, 0), (1, 0), (1, 1)])
def test_a_broadcast_is_meant_for_it_too(target: tuple[int, int]) -> None:
    """Target 0 is everyone."""
    here = station()
    assert here.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, target=target)[-1].result == ACCEPTED


def test_its_own_frames_are_ignored() -> None:
    """A link that loops does not make the copter talk to itself."""
    autopilot = Autopilot()
    own = Station(autopilot, system_id=1, component_id=1)
    assert own.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == []


@pytest.mark.parametrize(
    ("number", "entered"),
    [
        (mavlink.MAV_CMD_NAV_LAND, Mode.LAND),
        (mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, Mode.RTL),
        (mavlink.MAV_CMD_NAV_LOITER_UNLIM, Mode.LOITER),
    ],
)
def test_some_commands_change_the_mode(number: int, entered: Mode) -> None:
    """Land, return and loiter are modes, and the heartbeat shows them."""
    here = station()
    here.take_off()
    assert here.result(number) == ACCEPTED
    assert of_type(here.wait(1.5), "HEARTBEAT")[-1].custom_mode == entered


def test_a_speed_is_heeded() -> None:
    """DO_CHANGE_SPEED sets how fast it travels, in m/s."""
    here = station()
    here.take_off()
    assert here.result(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 3) == ACCEPTED
    far = (1, 1, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_CMD_DO_REPOSITION, 0, 0, -1, 0, 0, 0)
    assert here.tell(mavlink.MAVLink_command_int_message(*far, 474500000, 85455940, 5))[-1].result == ACCEPTED
    assert of_type(here.wait(10), "VFR_HUD")[-1].groundspeed == pytest.approx(3, abs=0.1)


def test_a_lost_ground_station_brings_the_copter_home() -> None:
    """In flight, silence for FS_GCS_TIMEOUT causes RTL; the copter lands, and the station may return."""
    here = station()
    here.wait(1.0)
    here.take_off()
    here.heartbeat()
    here.wait(4.9, heartbeats=False)
    assert mode(here) is Mode.GUIDED
    received = here.wait(0.3, heartbeats=False)
    assert mode(here) is Mode.RTL
    assert [message.text for message in of_type(received, "STATUSTEXT")] == ["GCS Failsafe"]
    here.wait(40, heartbeats=False)
    assert here.autopilot.vehicle.landed is Landed.ON_GROUND
    here.heartbeat()
    events = here.autopilot.counters.events
    assert (events["gcs_lost"], events["gcs_failsafe"], events["gcs_connected"], events["landed"]) == (1, 1, 2, 1)


def test_a_disabled_failsafe_leaves_the_copter_where_it_is() -> None:
    """With FS_GCS_ENABLE 0, the loss is only reported."""
    here = station()
    here.tell(mavlink.MAVLink_param_set_message(1, 1, b"FS_GCS_ENABLE", 0.0, mavlink.MAV_PARAM_TYPE_INT8))
    here.take_off()
    here.heartbeat()
    here.wait(6.0, heartbeats=False)
    assert mode(here) is Mode.GUIDED
    assert here.autopilot.counters.events["gcs_lost"] == 1


def test_stations_are_remembered_up_to_a_bound() -> None:
    """A flood of invented stations fills no memory, and the latest are kept."""
    autopilot = Autopilot()
    for system in range(2, 256):
        Station(autopilot, system_id=system).heartbeat()
    assert len(autopilot.stations) == 32
    assert autopilot.stations[-1] == (255, 190)


def test_it_goes_where_it_is_sent() -> None:
    """DO_REPOSITION and a position target in GUIDED fly to the place."""
    here = station()
    here.take_off()
    there = (1, 1, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_CMD_DO_REPOSITION, 0, 0, -1, 0, 0, 0)
    place = mavlink.MAVLink_command_int_message(*there, 473980000, 85460000, 9)
    assert here.tell(place)[-1].result == ACCEPTED
    last = of_type(here.wait(30), "GLOBAL_POSITION_INT")[-1]
    assert (last.lat, last.lon) == (pytest.approx(473980000, abs=60), pytest.approx(85460000, abs=60))
    assert last.relative_alt == pytest.approx(9000, abs=300)
    back = (0, 1, 1, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, 0x0FF8, 473977420, 85455940, 4.0, *[0.0] * 8)
    here.tell(mavlink.MAVLink_set_position_target_global_int_message(*back))
    assert of_type(here.wait(30), "GLOBAL_POSITION_INT")[-1].relative_alt == pytest.approx(4000, abs=300)


def _hostile_frame(number: int, payload: bytes) -> bytes:
    """A genuine frame of any payload: what pymavlink's own encoder would refuse to make."""
    head = struct.pack("<BBBBBB", len(payload), 0, 0, 0, 255, 190) + number.to_bytes(3, "little")
    crc = mavlink.x25crc(head + payload + bytes([mavlink.mavlink_map[number].crc_extra])).crc
    return b"\xfd" + head + payload + struct.pack("<H", crc)


HANDLED = [0, 4, 11, 20, 21, 23, 39, 40, 41, 43, 44, 45, 47, 51, 66, 73, 75, 76, 86, 110, 111]


@settings(deadline=None)  # the machine may be busy
@given(number=st.sampled_from(HANDLED), payload=st.binary(min_size=1, max_size=255), aimed=st.booleans())
def test_genuine_frames_of_any_content_do_not_stop_it(number: int, payload: bytes, aimed: bool) -> None:
    """After any well-formed frame, the copter continues to send valid frames."""
    here = station()
    frame = _hostile_frame(number, payload)
    if aimed:
        message = decode([frame])[0]
        message.target_system = message.target_component = 1
        frame = here.encode(message)
    decode(here.autopilot.receive(frame, here.now))
    assert here.autopilot.counters.frames_received == 1
    assert of_type(here.wait(1.5), "HEARTBEAT")


def test_random_bytes_do_not_stop_it() -> None:
    """Datagrams of noise are counted, and the next command is still obeyed."""
    here = station()
    noise = random.Random(5)
    for _ in range(500):
        assert here.autopilot.receive(noise.randbytes(noise.randrange(600)), 0.0) == []
    whole = here.encode(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))
    for cut in range(len(whole)):
        assert here.autopilot.receive(whole[:cut], 0.0) == []
    assert here.autopilot.split.garbage_bytes > 0
    assert here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED


def test_an_unknown_message_is_ignored() -> None:
    """A frame with an unknown message ID causes neither an answer nor an error."""
    here = station()
    head = struct.pack("<BBBBBB", 1, 0, 0, 0, 255, 190) + (9_999_999).to_bytes(3, "little")
    crc = mavlink.x25crc(head + b"x" + b"\0").crc
    assert here.autopilot.receive(b"\xfd" + head + b"x" + struct.pack("<H", crc), 0.0) == []


def test_mavlink_1_stations_are_understood() -> None:
    """A command in a MAVLink 1 frame is carried out."""
    here = station()
    message = mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
    frame = bytes(message.pack(mavlink.MAVLink(None, 255, 190), force_mavlink1=True))
    assert frame[0] == 0xFE
    assert decode(here.autopilot.receive(frame, 0.0))[-1].result == ACCEPTED


def test_next_due_at_is_never_later_than_what_is_due() -> None:
    """Advancing before the next due time sends no frame."""
    autopilot = Autopilot(AutopilotSettings(attitude_rate_hz=33))
    now, sent = 0.0, len(autopilot.advance(0.0))
    for _ in range(400):
        due = autopilot.next_due_at
        assert due > now
        if now < (now + due) / 2 < due:  # two that differ by rounding alone have nothing between them
            assert autopilot.advance((now + due) / 2) == []
        now = autopilot.next_due_at
        sent += len(autopilot.advance(now))
    assert sent > 100
