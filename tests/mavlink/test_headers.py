"""The facts in a frame's header, and the memory that keeps them."""

from __future__ import annotations

import pytest
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.samples import attitude, heartbeat, made, takeoff
from uavlinkd.mavlink import headers
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.mavlink.headers import Header

M = mavlink


@pytest.mark.parametrize(
    ("message", "version", "facts"),
    [
        (heartbeat(), 2, (0, 0, 0, None)),  # goes to all
        (takeoff(7, 9), 1, (76, 7, 9, 22)),
        (takeoff(7, 9), 2, (76, 7, 9, 22)),
        (M.MAVLink_mission_item_int_message(5, 6, 0, 3, 185, 0, 1, 1, 0, 0, 0, 0, 0, 0), 2, (73, 5, 6, 185)),
        (M.MAVLink_command_ack_message(22, 0), 2, (77, 0, 0, None)),  # names a command and asks for none
        (M.MAVLink_manual_control_message(9, 1, 2, 3, 4, 5), 2, (69, 9, 0, None)),  # its field is just "target"
    ],
)
def test_header_has_message_target_and_command(
    message: mavlink.MAVLink_message, version: int, facts: tuple[int, int, int, int | None]
) -> None:
    """They are read where the message's layout has them, in both versions."""
    header = header_of(made(message, system=42, version=version))
    assert (header.msgid, header.target_system, header.target_component, header.command) == facts
    assert (header.system, header.component, header.is_known) == (42, 1, True)
    assert header.is_mavlink1 == (version == 1)


@pytest.mark.parametrize("kept", range(34))
def test_fields_cut_from_the_payloads_end_are_zero(kept: int) -> None:
    """MAVLink 2 cuts trailing zeros: whatever is cut reads as 0, down to half a command number."""
    payload = bytes(28) + b"\x34\x12" + b"\x07\x09" + b"\x01"
    body = bytes([kept, 0, 0, 5, 1, 1, 76, 0, 0]) + payload[:kept]
    raw = b"\xfd" + body + mcrf4xx(body + bytes([152])).to_bytes(2, "little")
    frame = split_datagram(raw, SplitCounters())[0]
    command = 0x1234 if kept >= 30 else 0x34 if kept == 29 else 0
    assert (frame.header.command, frame.header.target_system, frame.header.target_component) == (
        command,
        7 if kept > 30 else 0,
        9 if kept > 31 else 0,
    )
    assert frame.header.is_known


def test_frames_that_say_the_same_share_a_header() -> None:
    """One object for each sender and message, for each target and command, for each version."""
    assert header_of(made(attitude())) is header_of(made(attitude(), signed=True))
    assert header_of(made(takeoff(7, 9))) is header_of(made(takeoff(7, 9)))
    others = [
        header_of(raw)
        for raw in (
            made(attitude()),
            made(attitude(), version=1),
            made(attitude(), system=2),
            made(heartbeat()),
            made(takeoff(7, 9)),
            made(takeoff(7, 8)),
            made(takeoff(6, 9)),
        )
    ]
    assert len(set(map(id, others))) == len(others)


def header_of(raw: bytes) -> Header:
    """The header of one frame."""
    (frame,) = split_datagram(raw, SplitCounters())
    return frame.header


def test_ground_station_may_address_many_targets_in_turn() -> None:
    """A second round over 250 systems gets the headers of the first: routing and policy have decided about them."""
    rounds = [[header_of(made(takeoff(target))) for target in range(1, 251)] for _ in range(2)]
    assert all(first is second for first, second in zip(*rounds, strict=True))


def test_memory_of_headers_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Invented senders and targets fill no memory. The oldest headers are forgotten, not all of them."""
    monkeypatch.setattr(headers, "MAX_SENDER_MESSAGES", 8)
    monkeypatch.setattr(headers, "MAX_TARGETED_HEADERS", 8)
    headers.sender_messages.clear()
    for system in range(1, 100):
        assert header_of(made(heartbeat(), system=system)).system == system
        assert len(headers.sender_messages) <= 8
    assert header_of(made(heartbeat(), system=95)) is header_of(made(heartbeat(), system=95))
    headers.targeted_headers.clear()
    latest = {target: header_of(made(takeoff(target))) for target in range(1, 100)}
    assert len(headers.targeted_headers) == 8
    assert [(header.target_system, header.command) for header in latest.values()] == [(n, 22) for n in range(1, 100)]
    assert all(header_of(made(takeoff(target))) is latest[target] for target in range(92, 100))
