"""A captured peer: whoever has its keys says what its policy lets it say, and nothing else reaches a program.

Each table is one victim's view of one captured peer. Every row is an attempt: the payload of a genuine envelope, what
of it is delivered, and what is counted. After each comes a frame that may pass: when it has arrived, so has all
before it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import (
    FAST,
    GROUND_SYSTEM,
    Rogue,
    Station,
    Tally,
    a_member,
    a_vehicle,
    ground_heartbeat,
    heartbeat,
    held_back,
    pack,
    station,
)
from tests.daemon.harness import DaemonProcess, Stage
from uavlinkd.config.keys import generate_psk

CAPTURED = 2
TABLET = 200
ARM, TAKE_OFF, TERMINATE = (
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
    mavlink.MAV_CMD_NAV_TAKEOFF,
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION,
)


class Attempt(NamedTuple):
    """A payload, the part of it that passes, and (message, reason) of what does not, each once unless counted."""

    what: str
    payload: bytes
    passing: bytes
    counted: dict[tuple[str, str], int]


def passes(what: str, frame: bytes) -> Attempt:
    """A frame that policy lets through."""
    return Attempt(what, frame, frame, {})


def refused(what: str, frame: bytes, message: str, reason: str) -> Attempt:
    """A frame that policy refuses."""
    return Attempt(what, frame, b"", {(message, reason): 1})


def long(number: int, system: int, target: int = 1, **fields: float) -> bytes:
    """COMMAND_LONG."""
    seven = [fields.get(f"param{n}", 0.0) for n in range(1, 8)]
    return pack(mavlink.MAVLink_command_long_message(target, 1, number, 0, *seven), system)


def int_(number: int, system: int, target: int = 1) -> bytes:
    """COMMAND_INT."""
    return pack(mavlink.MAVLink_command_int_message(target, 1, 6, number, 0, 0, 0, 0, 0, 0, 1, 1, 10), system)


def item_int(number: int, system: int) -> bytes:
    """MISSION_ITEM_INT; after the command everything is zero, so MAVLink 2 cuts it there."""
    message = mavlink.MAVLink_mission_item_int_message(1, 1, 0, 0, number, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    return pack(message, system)


def item(number: int, system: int, version: int = 2) -> bytes:
    """MISSION_ITEM."""
    message = mavlink.MAVLink_mission_item_message(1, 1, 0, 0, number, 0, 1, 0, 0, 0, 0, 0, 0, 0)
    return pack(message, system, version=version)


def with_checksum(frame: bytes, crc_extra: int) -> bytes:
    """An unsigned MAVLink 2 frame with the checksum of another definition of its message."""
    crc = mavlink.x25crc(frame[1:-2])
    crc.accumulate(bytes((crc_extra,)))
    return frame[:-2] + int(crc.crc).to_bytes(2, "little")


def broken(frame: bytes) -> bytes:
    """The frame with a checksum that no definition gives."""
    fitting = {with_checksum(frame, extra)[-2:] for extra in range(256)}
    free = next(each for n in range(65536) if (each := n.to_bytes(2, "little")) not in fitting)
    return frame[:-2] + free


def unknown(system: int, number: int = 54321) -> bytes:
    """A sound frame of a message that the dialect does not know."""
    header = bytes((0xFD, 4, 0, 0, 0, system, 1)) + number.to_bytes(3, "little")
    return with_checksum(header + b"\1\2\3\4" + b"\0\0", 77)


def signed(message: Any, system: int) -> bytes:
    """A frame with MAVLink's own signature."""
    codec = mavlink.MAVLink(None, system, 1)
    codec.signing.secret_key = bytes(range(32))
    codec.signing.sign_outgoing = True
    codec.signing.timestamp = 10**12
    return bytes(message.pack(codec))


def setup_signing(system: int, target: int = 1) -> bytes:
    """A new signing key for the victim."""
    return pack(mavlink.MAVLink_setup_signing_message(target, 1, bytes(range(32)), 10**12), system)


def of_everything(system: int, target: int = 1) -> dict[str, bytes]:
    """What nobody but an operator should say to an autopilot, by its message's name."""
    m = mavlink
    messages = (
        m.MAVLink_set_mode_message(target, 1, 4),
        m.MAVLink_param_set_message(target, 1, b"FS_GCS_ENABLE", 0, 9),
        m.MAVLink_mission_count_message(target, 1, 1),
        m.MAVLink_mission_clear_all_message(target, 1),
        m.MAVLink_mission_set_current_message(target, 1, 3),
        m.MAVLink_set_home_position_message(target, 1, 2, 3, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0),
        m.MAVLink_manual_control_message(target, 1000, 0, 0, 0, 0),
        m.MAVLink_rc_channels_override_message(target, 1, *[1900] * 8),
        m.MAVLink_set_position_target_local_ned_message(1, target, 1, 1, 0, 100, 0, -10, 0, 0, 0, 0, 0, 0, 0, 0),
        m.MAVLink_set_attitude_target_message(1, target, 1, 0, [1, 0, 0, 0], 0, 0, 0, 1),
        m.MAVLink_gps_input_message(1, 0, 0, 1, 0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 9),
        m.MAVLink_vision_position_estimate_message(1, 1, 1, 1, 0, 0, 0),
        m.MAVLink_gps_rtcm_data_message(0, 4, [1] * 180),
        m.MAVLink_adsb_vehicle_message(1, 1, 1, 0, 1, 0, 1, 0, b"AAA", 1, 1, 1, 1),
        m.MAVLink_follow_target_message(1, 1, 1, 1, 1, [0] * 3, [0] * 3, [1] * 4, [0] * 3, [0] * 3, 1),
        m.MAVLink_file_transfer_protocol_message(0, target, 1, [6] * 251),
        m.MAVLink_log_erase_message(target, 1),
        m.MAVLink_serial_control_message(10, 1, 0, 0, 4, [120] * 70),
        m.MAVLink_tunnel_message(target, 1, 1, 4, [1] * 128),
        m.MAVLink_can_frame_message(target, 1, 0, 8, 1, [1] * 8),
        m.MAVLink_device_op_write_message(target, 1, 1, 0, 0, 0, b"x", 0, 1, [1] * 128),
        m.MAVLink_v2_extension_message(0, target, 1, 1, [1] * 249),
        m.MAVLink_request_data_stream_message(target, 1, 0, 1, 0),
        m.MAVLink_change_operator_control_message(target, 0, 0, b"x"),
        m.MAVLink_secure_command_message(target, 1, 1, 1, 4, 0, [1] * 220),
        m.MAVLink_radio_status_message(1, 1, 0, 1, 1, 1, 1),
        m.MAVLink_led_control_message(target, 1, 0, 0, 1, [1] * 24),
        m.MAVLink_trajectory_representation_waypoints_message(1, 1, *[[1] * 5 for _ in range(11)], [TERMINATE] * 5),
    )
    return {message.get_type(): pack(message, system) for message in messages}


def malformed(own: bytes) -> list[Attempt]:
    """Payloads that are no whole genuine frames, for a peer that may say ``own``."""
    order = long(ARM, CAPTURED, param1=1)
    flags = own[:2] + b"\2" + own[3:]
    hiding = pack(mavlink.MAVLink_named_value_int_message(0, b"x", 0), CAPTURED)
    hiding = bytes((0xFD, 255)) + hiding[2:10] + order
    return [
        Attempt("a checksum that fits nothing", broken(own), b"", {("malformed", "bad_crc"): 1}),
        Attempt("that, and then a sound frame", broken(own) + own, own, {("malformed", "bad_crc"): 1}),
        Attempt("half a frame", own[: len(own) // 2], b"", {("malformed", "truncated"): 1}),
        Attempt("a start and nothing more", b"\xfd", b"", {("malformed", "truncated"): 1}),
        Attempt("flags that nobody knows", flags, b"", {("malformed", "unknown_flags"): 1}),
        Attempt("a sound frame and rubbish", own + b"rubbish", own, {("malformed", "not_mavlink"): 1}),
        Attempt("text", b"$GPGGA,1,2,3", b"", {("dropped", "bad_control"): 1}),
        Attempt("an order inside what is cut", hiding, b"", {("malformed", "truncated"): 1}),
        Attempt("control records that are none", b"\7" * 9, b"", {("dropped", "bad_control"): 1}),
    ]


def as_a_member() -> list[Attempt]:
    """What a drone lets another do: say that it is there, and where."""
    own = heartbeat(CAPTURED)
    gcs = mavlink.MAV_TYPE_GCS
    heartbeat_message = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
    position = mavlink.MAVLink_global_position_int_message(1, 1, 1, 1, 1, 0, 0, 0, 0)
    attitude = mavlink.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0)
    return [
        passes("its heartbeat", own),
        passes("its heartbeat, signed", signed(heartbeat_message, CAPTURED)),
        passes("its heartbeat in MAVLink 1", heartbeat(CAPTURED, version=1)),
        passes("its position", pack(position, CAPTURED)),
        passes("another component of its own", pack(attitude, CAPTURED, 191)),
        refused("the station's heartbeat", ground_heartbeat(), "HEARTBEAT", "foreign_system"),
        refused("the victim's own heartbeat", heartbeat(1), "HEARTBEAT", "foreign_system"),
        refused("another drone's position", pack(position, 3), "GLOBAL_POSITION_INT", "foreign_system"),
        refused("system 0", heartbeat(0), "HEARTBEAT", "foreign_system"),
        refused("the station's order", long(ARM, GROUND_SYSTEM), "COMMAND_LONG", "foreign_system"),
        refused("the station's order, MAVLink 1", item(TERMINATE, 255, 1), "MISSION_ITEM", "foreign_system"),
        refused("a station's, as itself", heartbeat(CAPTURED, kind=gcs), "HEARTBEAT", "ground_station_not_allowed"),
        refused(
            "the same in MAVLink 1",
            heartbeat(CAPTURED, kind=gcs, version=1),
            "HEARTBEAT",
            "ground_station_not_allowed",
        ),
        refused("arm", long(ARM, CAPTURED, param1=1), "COMMAND_LONG", "message_not_allowed"),
        refused("terminate, to all", long(TERMINATE, CAPTURED, 0, param1=1), "COMMAND_LONG", "message_not_allowed"),
        refused("go there", int_(mavlink.MAV_CMD_DO_REPOSITION, CAPTURED), "COMMAND_INT", "message_not_allowed"),
        refused("a mission item", item_int(TERMINATE, CAPTURED), "MISSION_ITEM_INT", "message_not_allowed"),
        *(refused(name, frame, name, "message_not_allowed") for name, frame in of_everything(CAPTURED).items()),
        refused("a signing key", setup_signing(CAPTURED), "SETUP_SIGNING", "setup_signing"),
        refused("the same, otherwise defined", with_checksum(setup_signing(2), 9), "SETUP_SIGNING", "setup_signing"),
        refused("a message that nobody knows", unknown(CAPTURED), "54321", "unknown_message"),
        refused("a heartbeat otherwise defined", with_checksum(own, 51), "HEARTBEAT", "unknown_message"),
        Attempt(
            "an order between what may pass",
            own + long(ARM, CAPTURED, param1=1) + own,
            own + own,
            {("COMMAND_LONG", "message_not_allowed"): 1},
        ),
        *malformed(own),
    ]


def as_a_vehicle() -> list[Attempt]:
    """What a ground station lets a drone do: report and answer."""
    own = heartbeat(CAPTURED)
    m = mavlink
    asks = {
        name: frame
        for name, frame in of_everything(CAPTURED, GROUND_SYSTEM).items()
        # A vehicle reports these, of itself or of what is around it.
        if name not in ("MISSION_COUNT", "ADSB_VEHICLE", "FOLLOW_TARGET", "FILE_TRANSFER_PROTOCOL", "RADIO_STATUS")
    }
    position = m.MAVLink_global_position_int_message(1, 1, 1, 1, 1, 0, 0, 0, 0)
    acknowledged = m.MAVLink_command_ack_message(ARM, 0)
    return [
        passes("its heartbeat", own),
        passes("its position", pack(position, CAPTURED)),
        passes("an acknowledgement", pack(acknowledged, CAPTURED)),
        passes("a parameter", pack(m.MAVLink_param_value_message(b"X", 1, 9, 1, 0), CAPTURED)),
        passes("a text", pack(m.MAVLink_statustext_message(3, b"PreArm: check"), CAPTURED)),
        passes("put me on my side", long(m.MAV_CMD_ACCELCAL_VEHICLE_POS, CAPTURED, GROUND_SYSTEM)),
        refused("another drone's heartbeat", heartbeat(1), "HEARTBEAT", "foreign_system"),
        refused("another drone's position", pack(position, 1), "GLOBAL_POSITION_INT", "foreign_system"),
        refused("another drone's answer", pack(acknowledged, 1), "COMMAND_ACK", "foreign_system"),
        refused("the station itself", ground_heartbeat(), "HEARTBEAT", "foreign_system"),
        refused("the station's order", long(ARM, GROUND_SYSTEM), "COMMAND_LONG", "foreign_system"),
        refused(
            "a station's heartbeat, as itself",
            heartbeat(CAPTURED, kind=m.MAV_TYPE_GCS),
            "HEARTBEAT",
            "ground_station_not_allowed",
        ),
        refused("an order to another drone", long(ARM, CAPTURED, 1), "COMMAND_LONG", "command_not_allowed"),
        refused("an order to all", long(TERMINATE, CAPTURED, 0), "COMMAND_LONG", "command_not_allowed"),
        refused("go there", int_(m.MAV_CMD_DO_REPOSITION, CAPTURED), "COMMAND_INT", "command_not_allowed"),
        *(refused(name, frame, name, "message_not_allowed") for name, frame in asks.items()),
        refused("a signing key", setup_signing(CAPTURED, 255), "SETUP_SIGNING", "setup_signing"),
        refused("a message that nobody knows", unknown(CAPTURED), "54321", "unknown_message"),
        *malformed(own),
    ]


def as_an_observer() -> list[Attempt]:
    """What a drone lets a tablet do: look on, and ask what changes nothing."""
    own = pack(mavlink.MAVLink_ping_message(1, 2, 0, 0), TABLET)
    m = mavlink
    first_four = m.MAV_CMD_REQUEST_MESSAGE
    return [
        passes("a ping", own),
        passes("all parameters, please", pack(m.MAVLink_param_request_list_message(1, 1), TABLET)),
        passes("the mission, please", pack(m.MAVLink_mission_request_list_message(1, 1), TABLET)),
        passes("one message, please", long(first_four, TABLET, param1=148)),
        passes("the same in the other form", int_(first_four, TABLET)),
        refused("a heartbeat, which would feed a failsafe", heartbeat(TABLET), "HEARTBEAT", "message_not_allowed"),
        refused("the station's", ground_heartbeat(), "HEARTBEAT", "foreign_system"),
        refused("the station's order", long(ARM, GROUND_SYSTEM), "COMMAND_LONG", "foreign_system"),
        refused("arm", long(ARM, TABLET, param1=1), "COMMAND_LONG", "command_not_allowed"),
        refused("terminate", long(TERMINATE, TABLET, param1=1), "COMMAND_LONG", "command_not_allowed"),
        refused(
            "less telemetry", long(m.MAV_CMD_SET_MESSAGE_INTERVAL, TABLET), "COMMAND_LONG", "command_not_allowed"
        ),
        refused("go there", int_(m.MAV_CMD_DO_REPOSITION, TABLET), "COMMAND_INT", "command_not_allowed"),
        refused("a mission item", item(TAKE_OFF, TABLET), "MISSION_ITEM", "message_not_allowed"),
        *(refused(name, frame, name, "message_not_allowed") for name, frame in of_everything(TABLET).items()),
        refused("a signing key", setup_signing(TABLET), "SETUP_SIGNING", "setup_signing"),
        refused("a message that nobody knows", unknown(TABLET), "54321", "unknown_message"),
        *malformed(own),
    ]


def as_an_operator() -> list[Attempt]:
    """What a drone lets its ground station do: operate it, but for what is denied; no shell, bus or MAVLink 1."""
    own = ground_heartbeat()
    everything = of_everything(GROUND_SYSTEM)
    shell = ("SERIAL_CONTROL", "TUNNEL", "CAN_FRAME", "DEVICE_OP_WRITE", "V2_EXTENSION")
    other = ("SECURE_COMMAND", "RADIO_STATUS", "GPS_INPUT", "VISION_POSITION_ESTIMATE")
    denied = ("SET_MODE", "TRAJECTORY_REPRESENTATION_WAYPOINTS")
    may = {name: frame for name, frame in everything.items() if name not in (*shell, *other, *denied)}
    assert len(may) == len(everything) - 11
    return [
        passes("its heartbeat", own),
        passes("take off", long(TAKE_OFF, GROUND_SYSTEM, param7=3)),
        passes("a mission item", item_int(TAKE_OFF, GROUND_SYSTEM)),
        *(passes(name, frame) for name, frame in may.items()),
        refused("terminate", long(TERMINATE, GROUND_SYSTEM, param1=1), "COMMAND_LONG", "command_not_allowed"),
        refused("terminate, to all", long(TERMINATE, 255, 0, param1=1), "COMMAND_LONG", "command_not_allowed"),
        refused("in the other form", int_(TERMINATE, GROUND_SYSTEM), "COMMAND_INT", "command_not_allowed"),
        refused("in a mission", item_int(TERMINATE, GROUND_SYSTEM), "MISSION_ITEM_INT", "command_not_allowed"),
        refused("in a float mission", item(TERMINATE, GROUND_SYSTEM), "MISSION_ITEM", "command_not_allowed"),
        refused("among waypoints", everything[denied[1]], denied[1], "command_not_allowed"),
        refused(
            "in a command otherwise defined",
            with_checksum(long(TERMINATE, GROUND_SYSTEM, param1=1), 3),
            "COMMAND_LONG",
            "unknown_message",
        ),
        refused("a mode, by another name", everything["SET_MODE"], "SET_MODE", "command_not_allowed"),
        refused("in MAVLink 1", item(TERMINATE, GROUND_SYSTEM, version=1), "MISSION_ITEM", "mavlink1_not_allowed"),
        *(refused(name, everything[name], name, "message_not_allowed") for name in (*shell, *other)),
        refused("as the drone", heartbeat(1), "HEARTBEAT", "foreign_system"),
        refused("a signing key", setup_signing(GROUND_SYSTEM), "SETUP_SIGNING", "setup_signing"),
        *malformed(own),
    ]


class Table(NamedTuple):
    """A victim's policy for the captured peer, the attempts, and a frame that may pass, by its number."""

    policy: dict[str, object]
    attempts: Callable[[], list[Attempt]]
    marker: Callable[[int], bytes]


TABLES = {
    "member": Table(a_member(CAPTURED) | FAST, as_a_member, lambda n: heartbeat(CAPTURED, seq=n, kind=13)),
    "vehicle": Table(a_vehicle(CAPTURED), as_a_vehicle, lambda n: heartbeat(CAPTURED, seq=n, kind=13)),
    "observer": Table(
        {"role": "observer", "system_ids": [TABLET], **FAST},
        as_an_observer,
        lambda n: pack(mavlink.MAVLink_ping_message(1000 + n, n, 0, 0), TABLET),
    ),
    "operator": Table(
        {
            "role": "operator",
            "system_ids": [GROUND_SYSTEM],
            "deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION", "MAV_CMD_DO_SET_MODE"],
            "mavlink1": False,
        },
        as_an_operator,
        lambda n: ground_heartbeat(seq=1 + n % 255),
    ),
}


async def besieged(stage: Stage, policy: dict[str, object], psk: str) -> tuple[DaemonProcess, DaemonProcess, Station]:
    """A victim with one peer, whose keys are out, and a program that hears what gets through."""
    victim, captured = stage.daemon("victim"), stage.daemon("captured")
    stage.secrets.append(psk)
    victim.add_peer(captured, [], psk, **policy)
    program = await station(stage)
    victim.add_endpoint("program", f"udpout:{program}")
    await stage.start(victim, linked=False)
    await victim.until(lambda status: bool(status["endpoints"]["program"]["programs"]))
    return victim, captured, program


@pytest.mark.parametrize("kind", TABLES)
async def test_it_says_what_its_policy_lets_it_say(stage: Stage, kind: str) -> None:
    """Of each attempt exactly what the policy allows is delivered, and all else is counted under its reason."""
    table = TABLES[kind]
    psk = generate_psk()
    victim, captured, program = await besieged(stage, table.policy, psk)
    wrong: list[str] = []
    async with Rogue(captured, victim, psk) as rogue:
        before: Tally = Counter()
        for number, attempt in enumerate(table.attempts()):
            marker = table.marker(number)
            program.clear()
            rogue.say(attempt.payload)
            rogue.say(marker)
            await program.until_heard(marker)
            tally = held_back(await victim.status(), "peers", captured.name)
            if bytes(program.received) != attempt.passing + marker:
                wrong.append(f"{attempt.what}: {bytes(program.received).hex(' ')} came out")
            if tally - before != Counter(attempt.counted):
                wrong.append(f"{attempt.what}: counted {dict(tally - before)}")
            before = tally
    assert not wrong, "\n".join(wrong)


async def test_rates_bind_it(stage: Stage) -> None:
    """Of a burst of a message with a rate limit two pass, and the rest are counted; other messages go on."""
    psk = generate_psk()
    policy = {**a_member(CAPTURED), "rate_in": {"ATTITUDE": 2}}
    victim, captured, program = await besieged(stage, policy, psk)
    burst = [pack(mavlink.MAVLink_attitude_message(n, 0, 0, 0, 0, 0, 0), CAPTURED, seq=n) for n in range(20)]
    async with Rogue(captured, victim, psk) as rogue:
        rogue.say(b"".join(burst) + heartbeat(CAPTURED))
        await program.until_heard(heartbeat(CAPTURED))
        assert program.frames == [*burst[:2], heartbeat(CAPTURED)]
        tally = held_back(await victim.status(), "peers", captured.name)
        assert tally == {("ATTITUDE", "rate_limited"): 18}


async def test_it_is_told_no_more_than_its_role_is(stage: Stage) -> None:
    """An observer hears telemetry; orders, keys, files and parameters set are never sent to it, and are counted."""
    psk = generate_psk()
    victim, captured, program = await besieged(stage, {"role": "observer", "system_ids": [TABLET]}, psk)
    kept = {
        name: frame
        for name, frame in of_everything(GROUND_SYSTEM, 0).items()
        # These a vehicle reports as well: whose they are does not show in the message.
        if name not in ("MISSION_COUNT", "ADSB_VEHICLE", "FOLLOW_TARGET")
    }
    async with Rogue(captured, victim, psk) as rogue:
        rogue.say(pack(mavlink.MAVLink_ping_message(1, 2, 0, 0), TABLET))
        await program.until(lambda: bool(program.received))
        into = program.sources[-1]
        for frame in (heartbeat(1), *kept.values(), long(ARM, GROUND_SYSTEM, 0), setup_signing(GROUND_SYSTEM, 0)):
            program.send(frame, into)
        program.send(heartbeat(1, seq=1), into)
        await rogue.until(lambda: heartbeat(1, seq=1) in rogue.heard)
        status = await victim.status()
        tally = held_back(status, "peers", captured.name, "out")
        unsaid = held_back(status, "endpoints", "program")
    assert bytes(rogue.heard) == heartbeat(1) + heartbeat(1, seq=1)
    assert unsaid == {("SETUP_SIGNING", "setup_signing"): 1}
    assert tally == {(name, "message_not_allowed"): 1 for name in ("COMMAND_LONG", *kept)}
