"""What the roles let pass: neither more than their purpose needs, nor less than recorded flights have.

``test_role_holes`` has the frames on which real autopilots acted although a role only reads.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.policy.test_gate import GCS, TAKEOFF, TERMINATE, compiled, foreign, incoming, passing, raw_frame
from tests.samples import (
    ID,
    attitude,
    blank,
    command_int,
    command_long,
    frame,
    frames_of,
    heartbeat,
    mission_item,
    position,
)
from tests.tlog import read_tlog
from uavlinkd.mavlink.dialect import COMMANDS, GROUPS
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.policy.gate import SYSTEM_SHARE, Refusal
from uavlinkd.mavlink.policy.roles import ROLES

# Roles.

CAPTURED = [
    ("takes off another", command_long(TAKEOFF), Refusal.MESSAGE_NOT_ALLOWED),
    ("terminates another", command_int(TERMINATE), Refusal.MESSAGE_NOT_ALLOWED),
    ("commands as the ground station", command_long(TERMINATE, 255), Refusal.FOREIGN_SYSTEM),
    ("speaks as another drone", heartbeat(system=3), Refusal.FOREIGN_SYSTEM),
    ("speaks as all", heartbeat(system=0), Refusal.FOREIGN_SYSTEM),
    ("poses as a ground station", heartbeat(kind=GCS), Refusal.GROUND_STATION_NOT_ALLOWED),
    ("plants a mission", mission_item(TERMINATE), Refusal.MESSAGE_NOT_ALLOWED),
    ("plants a signing key", blank(256), Refusal.SETUP_SIGNING),
    ("sends an unknown message", raw_frame(0xFFFFFF, b"x"), Refusal.UNKNOWN_MESSAGE),
    ("sends its own ATTITUDE", foreign(30), Refusal.UNKNOWN_MESSAGE),
    ("sends MAVLink 1", heartbeat(version=1), Refusal.MAVLINK1_NOT_ALLOWED),
]


@pytest.mark.parametrize(("attempt", "one", "reason"), CAPTURED, ids=[c[0] for c in CAPTURED])
def test_captured_swarm_member_cannot_command(attempt: str, one: Frame, reason: Refusal) -> None:
    """With its real keys a captured drone can still send only presence and position; each attempt is counted."""
    gate = incoming(role="swarm-member", system_ids=[1], mavlink1=False)
    assert gate.check(one, 0.0) is reason, attempt
    assert gate.refused == {(one.header.msgid, reason): 1}
    assert gate.check(heartbeat(), 0.0) is gate.check(attitude(), 0.0) is None


COMMANDING = [
    *("commands", "parameters", "setpoints", "manual", "shell", "firmware", "control-access", "sensors"),
    *("simulation", "rtk", "signing", "test", "transponder"),
]


def in_groups(groups: list[str]) -> set[str]:
    return {name for group in groups for name in GROUPS[group]}


def test_only_an_operator_changes_a_vehicle() -> None:
    """A member sends presence and position; an observer reads and requests single messages, in no other form."""
    assert passing(incoming(role="swarm-member")) == {*GROUPS["heartbeat"], *GROUPS["position"]}
    observer = incoming(role="observer", system_ids=[1])
    assert passing(observer) == {*GROUPS["parameter-reads"], *GROUPS["mission-reads"], "PING"}
    for make in (command_long, command_int):
        verdicts = {number: observer.check(make(number, first=30), 1.0) for number in (511, TAKEOFF, 512)}
        assert verdicts == {511: Refusal.COMMAND_NOT_ALLOWED, TAKEOFF: Refusal.COMMAND_NOT_ALLOWED, 512: None}


def test_vehicle_cannot_command_its_operator() -> None:
    """A vehicle's role allows reports and answers; it sends no command and sets nothing."""
    gate = incoming(role="vehicle")
    passed = passing(gate)
    assert {"COMMAND_ACK", "PARAM_VALUE", "STATUSTEXT", "RADIO_STATUS", "EVENT"} <= passed
    harmless = in_groups(["answers", "telemetry", "traffic"])
    harmless |= {"UAVIONIX_ADSB_OUT_STATUS", "UAVIONIX_ADSB_TRANSCEIVER_HEALTH_REPORT"}
    assert passed & in_groups([*COMMANDING, "streams", "signals"]) <= harmless
    assert gate.check(command_long(COMMANDS["MAV_CMD_ACCELCAL_VEHICLE_POS"]), 0.0) is None
    assert gate.check(command_long(TAKEOFF), 0.0) is Refusal.COMMAND_NOT_ALLOWED


def test_operator_may_operate() -> None:
    """An operator commands, sets parameters and plans missions; it has no shell, and no simulator's sensors."""
    gate = incoming(role="operator")
    passed = passing(gate)
    assert in_groups(["commands", "parameters", "mission", "setpoints", "manual", "files", "rtk"]) <= passed
    assert {"LED_CONTROL", "REQUEST_EVENT", "PLAY_TUNE_V2", "CHANGE_OPERATOR_CONTROL", "TIMESYNC"} <= passed
    assert not passed & (in_groups(["shell", "firmware", "simulation"]) | {"SECURE_COMMAND", "GPS_INPUT", "EVENT"})
    assert gate.check(command_long(TERMINATE), 0.0) is None


# Files.

FTP = ID["FILE_TRANSFER_PROTOCOL"]
READING = {
    *("TERMINATESESSION", "RESETSESSION", "LISTDIRECTORY", "OPENFILERO", "READFILE", "CALCFILECRC"),
    *("BURSTREADFILE", "ACK", "NAK"),
}
OPCODES = {
    name.removeprefix("MAV_FTP_OPCODE_"): number
    for name, number in vars(mavlink).items()
    if name.startswith("MAV_FTP_OPCODE_") and not name.endswith("ENUM_END")
}


def request(opcode: int, *, version: int = 2, path: bytes = b"/fs/x") -> Frame:
    """A request as pymavlink's MAVFTP packs it: sequence, session, opcode, size, of what, complete, offset, data."""
    payload = bytes((7, 0, 1, opcode, len(path), 0, 0, 0, 0, 0, 0, 0)) + path
    message = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, list(payload.ljust(251, b"\0")))
    return frame(message, version=version)


@pytest.mark.parametrize("version", [1, 2])
def test_files_read_passes_reading_requests_only(version: int) -> None:
    """Create, write, remove, rename, and numbers that MAVLink does not define, are refused."""
    gate = incoming(allow_in=["files-read"])
    assert set(OPCODES) > READING
    reading = {OPCODES[name] for name in READING}
    for opcode in range(256):
        refusal = gate.check(request(opcode, version=version), 0.0)
        assert refusal is (None if opcode in reading else Refusal.FILE_WRITE_NOT_ALLOWED), opcode


@pytest.mark.parametrize("version", [1, 2])
def test_only_the_operator_requests_files(version: int) -> None:
    """A captured vehicle answers file transfers, and requests none of its operator: no opcode but ACK and NAK."""
    vehicle, operator = incoming(role="vehicle"), incoming(role="operator", system_ids=[1])
    for opcode in range(256):
        passes = opcode in (OPCODES["ACK"], OPCODES["NAK"])
        refusal = vehicle.check(request(opcode, version=version), 0.0)
        assert refusal is (None if passes else Refusal.FILE_WRITE_NOT_ALLOWED), opcode
        assert operator.check(request(opcode, version=version), 0.0) is None


SECRETS = [
    *(
        "/mavlink/mavlink-signing-key.bin",
        "mavlink/MAVLINK-SIGNING-KEY.BIN",
        "/fs/microsd/mavlink/mavlink-signing-key.bin",
    ),
    *("/MAVLINK/MAVLIN~1.BIN", "/mavl~1", "@SYS/storage.bin", "@SYS//storage.bin", "./@SYS/flash.bin"),
    *(
        "@SYS/crash_dump.bin",
        "/fs/mtd_params",
        "/dev/mtd0",
        "//./dev/ram0",
        "dev/ram0",
        "/mavlink/mavlink-\u017figning-key.bin",
    ),
    "/a.txt\0/mavlink/mavlink-signing-key.bin",
]


@pytest.mark.parametrize("data", [{}, {"role": "operator", "system_ids": [1]}, {"allow_in": ["files-read"]}])
def test_no_policy_passes_a_request_for_a_file_with_keys(data: dict[str, object]) -> None:
    """By each opcode that has a path. What a file contains is not a path, and other files pass."""
    made = compiled(data)
    for path in SECRETS:
        for opcode in set(range(256)) - {0, 1, 2, 5, 7, 15, 128, 129}:
            refusal = made.incoming.check(request(opcode, path=path.encode()), 0.0)
            wanted = {Refusal.SETUP_SIGNING} | ({Refusal.FILE_WRITE_NOT_ALLOWED} if "allow_in" in data else set())
            assert refusal in wanted, (path, opcode)
        assert made.incoming.check(request(OPCODES["ACK"], path=path.encode()), 0.0) is None
    for path in (
        "/APM/LOGS/00000001.BIN",
        "@PARAM/param.pck",
        "@SYS/threads.txt",
        "/etc/device.txt",
        "/fs/microsd/log",
    ):
        for name in ("OPENFILERO", "LISTDIRECTORY", "CALCFILECRC"):
            assert made.incoming.check(request(OPCODES[name], path=path.encode()), 0.0) is None, path


def test_opcode_is_read_where_its_sender_wrote() -> None:
    """The seventh byte of the payload. Cut off it is 0, which is refused; in another definition it is unreadable."""
    gate = incoming(allow_in=["files-read"])
    for payload in (b"\1", b"\1" * 3, b"\1" * 6, b"\5" * 6 + b"\7"):
        assert gate.check(raw_frame(FTP, payload), 0.0) is Refusal.FILE_WRITE_NOT_ALLOWED
    assert gate.check(raw_frame(FTP, b"\1" * 6 + b"\5"), 0.0) is None
    assert gate.check(foreign(FTP, b"\5" * 20), 0.0) is Refusal.UNKNOWN_MESSAGE


def test_files_read_adds_to_other_entries_and_roles() -> None:
    """Logs are read and not erased; a wider entry allows writing, a rate applies to what passes."""
    logs = {"LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_REQUEST_END", "LOG_ENTRY", "LOG_DATA"}
    assert passing(incoming(allow_in=["files-read"])) == logs
    for more in ("files", "FILE_TRANSFER_PROTOCOL", 110, "all"):
        assert incoming(allow_in=["files-read", more]).check(request(OPCODES["WRITEFILE"]), 0.0) is None
    gate = incoming(allow_in=["files-read"], rate_in={"files-read": 1})
    assert gate.check(request(OPCODES["WRITEFILE"]), 0.0) is Refusal.FILE_WRITE_NOT_ALLOWED
    assert [gate.check(request(OPCODES["READFILE"]), 0.0) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]
    made = compiled({"role": "observer", "allow_in": ["files-read"], "allow_out": ["files-read"]})
    rows = {row.subject: row for row in made.describe()}
    assert rows["files-read"][1:] == ("all (not all requests: FILE_TRANSFER_PROTOCOL)",) * 2
    assert not any("FILE_TRANSFER_PROTOCOL" in warning for warning in made.warnings)


# Rates.

FLIGHTS = ("arducopter_sitl_flight.tlog", "ardusub_dive.tlog", "copter_flight_mavlink1.tlog")
WITH_RATES = ("swarm-member", "observer")


@cache
def flight(path: Path) -> list[tuple[float, Frame]]:
    """The genuine frames of a recorded flight, and the time of each."""
    records = read_tlog(path)
    return [(record.time_us / 1e6, one) for record in records for one in frames_of([record.frame])]


@pytest.mark.parametrize("name", FLIGHTS)
@pytest.mark.parametrize("role", ROLES)
def test_recorded_flight_passes_unchanged(shared_data: Path, role: str, name: str) -> None:
    """No frame of a flight that its role allows exceeds its rate."""
    gate = incoming(role=role)
    verdicts = [gate.check(one, now) for now, one in flight(shared_data / name)]
    assert Refusal.RATE_LIMITED not in verdicts
    assert None in verdicts


def test_follow_me_has_its_positions() -> None:
    """Ten positions a second pass, also if a link delivers half a second of them at once."""
    gate = incoming(role="swarm-member")
    assert all(gate.check(position(n), n / 10) is None for n in range(600))
    assert all(gate.check(position(n), 60.0 + n // 5 * 0.5) is None for n in range(600))


@pytest.mark.parametrize(("components", "rates"), [(1, 1), (250, SYSTEM_SHARE)])
def test_flood_of_positions_is_limited(components: int, rates: int) -> None:
    """Of two thousand a second, 50 of one component pass, and sixteen times that of a whole system."""
    gate, seconds = incoming(role="swarm-member"), 5
    flood = (position(n, 1, n % components + 1) for n in range(2000 * seconds))
    passed = sum(gate.check(one, n / 2000) is None for n, one in enumerate(flood))
    assert 50 * rates * seconds <= passed <= 50 * rates * (seconds + 0.5)


def test_every_message_of_a_role_that_does_not_operate_has_a_rate() -> None:
    """An operator and a vehicle have no limit."""
    for role in ROLES:
        gate = incoming(role=role)
        unlimited = {name for name, msgid in ID.items() if gate.decide(msgid, is_known=True) is None}
        assert bool(ROLES[role].rate_in) is (not unlimited) is (role in WITH_RATES)


def test_own_rate_replaces_the_roles() -> None:
    """A rate in the configuration, of the message or of a group with it, replaces the role's; others stay."""
    for own in ({"ATTITUDE": 500}, {"position": 500}):
        gate = incoming(role="swarm-member", rate_in=own)
        assert sum(gate.check(attitude(n), n / 400) is None for n in range(400)) == 400
        assert sum(gate.check(heartbeat(n), n / 400) is None for n in range(400)) < 10
