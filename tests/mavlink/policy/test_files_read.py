"""The group `files-read`: MAVFTP's reading requests and log download, without writing."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.policy.test_policy import blank, compiled, ids, incoming, raw_frame, sent
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.policy.gate import Gate, Refusal

FTP = dialect.ids_by_name()["FILE_TRANSFER_PROTOCOL"]
READING = {
    *("TERMINATESESSION", "RESETSESSION", "LISTDIRECTORY", "OPENFILERO", "READFILE", "CALCFILECRC"),
    *("BURSTREADFILE", "ACK", "NAK"),
}
OPCODES = {
    name.removeprefix("MAV_FTP_OPCODE_"): number
    for name, number in vars(mavlink).items()
    if name.startswith("MAV_FTP_OPCODE_") and not name.endswith("ENUM_END")
}


def request(opcode: int, *, version: int = 2, data: bytes = b"/fs/x") -> Frame:
    """A request as pymavlink's MAVFTP packs it: sequence, session, opcode, size, of what, complete, offset, data."""
    header = bytes((7, 0, 1, opcode, len(data), 0, 0, 0, 0, 0, 0, 0))
    payload = (header + data).ljust(251, b"\0")
    return sent(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, list(payload)), version=version)


@pytest.fixture
def gate() -> Gate:
    """A policy that allows only reading files."""
    return incoming({"system_ids": "all", "allow_in": ["files-read"]})


def test_reading_opcodes_exist() -> None:
    """MAVLink's definition has the names of this test."""
    assert set(OPCODES) > READING


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", OPCODES)
def test_each_opcode(gate: Gate, name: str, version: int) -> None:
    """Reading passes; create, write, remove, rename, truncate, directories and opening to write do not."""
    refusal = gate.check(request(OPCODES[name], version=version), 0.0)
    assert refusal == (None if name in READING else Refusal.FILE_WRITE_NOT_ALLOWED)


def test_opcode_beyond_the_definition_is_refused(gate: Gate) -> None:
    """A number that MAVLink does not define may have any effect."""
    for opcode in set(range(256)) - set(OPCODES.values()):
        assert gate.check(request(opcode), 0.0) is Refusal.FILE_WRITE_NOT_ALLOWED


@pytest.mark.parametrize("length", [1, 3, 6])
def test_opcode_that_was_cut_off_is_zero(gate: Gate, length: int) -> None:
    """MAVLink 2 truncates zeros: a frame that ends before the opcode has opcode 0, which is refused."""
    assert gate.check(raw_frame(FTP, b"\x01" * length), 0.0) is Refusal.FILE_WRITE_NOT_ALLOWED


def test_payload_that_ends_with_its_opcode_is_read(gate: Gate) -> None:
    """The opcode is the seventh byte of the message's payload."""
    assert gate.check(raw_frame(FTP, b"\x01" * 6 + b"\x05"), 0.0) is None
    assert gate.check(raw_frame(FTP, b"\x05" * 6 + b"\x07"), 0.0) is Refusal.FILE_WRITE_NOT_ALLOWED


def test_another_definition_is_refused(gate: Gate) -> None:
    """In another definition than the dialect's, the opcode cannot be read."""
    frame = raw_frame(FTP, b"\x05" * 20, crc_extra=1)
    assert gate.check(frame, 0.0) is Refusal.UNKNOWN_MESSAGE


def test_logs_are_read_and_not_erased(gate: Gate) -> None:
    """Log download passes in both directions; LOG_ERASE and other transfers do not."""
    for msgid in ids("LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_REQUEST_END", "LOG_ENTRY", "LOG_DATA"):
        assert gate.check(blank(msgid), 0.0) is None
    for msgid in ids("LOG_ERASE", "LOGGING_DATA", "REMOTE_LOG_BLOCK_STATUS", "RESOURCE_REQUEST", "PARAM_SET"):
        assert gate.check(blank(msgid), 0.0) is Refusal.MESSAGE_NOT_ALLOWED


@pytest.mark.parametrize("more", ["files", "FILE_TRANSFER_PROTOCOL", 110, "all"])
def test_wider_entry_allows_writing(more: str | int) -> None:
    """A list's entries add up."""
    gate = incoming({"system_ids": "all", "allow_in": ["files-read", more]})
    assert gate.check(request(OPCODES["WRITEFILE"]), 0.0) is None


@pytest.mark.parametrize("deny", ["files", "files-read", "FILE_TRANSFER_PROTOCOL", 110])
def test_denied_is_denied_whole(deny: str | int) -> None:
    """A denial applies to the whole message, so that denying to read does not leave writing open."""
    gate = incoming({"system_ids": "all", "allow_in": ["all", "files-read"], "deny_in": [deny]})
    for name in ("READFILE", "WRITEFILE"):
        assert gate.check(request(OPCODES[name]), 0.0) is Refusal.MESSAGE_NOT_ALLOWED


def test_rate_applies_to_reading() -> None:
    """A refused write does not use the rate."""
    gate = incoming({"system_ids": "all", "allow_in": ["files-read"], "rate_in": {"files-read": 1}})
    assert gate.check(request(OPCODES["WRITEFILE"]), 0.0) is Refusal.FILE_WRITE_NOT_ALLOWED
    assert [gate.check(request(OPCODES["READFILE"]), 0.0) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]


def test_observer_may_be_given_files_to_read() -> None:
    """The group extends a role, in each direction."""
    data = {"role": "observer", "system_ids": [254], "allow_in": ["files-read"], "allow_out": ["files-read"]}
    made = compiled(data)
    assert made.incoming.check(request(OPCODES["OPENFILEWO"]), 0.0) is Refusal.FOREIGN_SYSTEM
    assert made.outgoing.check(request(OPCODES["ACK"]), 0.0) is None
    rows = {row.subject: row for row in made.describe()}
    assert rows["files-read"][1:] == ("all (only reading: FILE_TRANSFER_PROTOCOL)",) * 2
    assert not any("FILE_TRANSFER_PROTOCOL" in warning for warning in made.warnings)
