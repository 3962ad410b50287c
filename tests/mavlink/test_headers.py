"""The facts in a frame's header, and the memory that keeps them."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.shapes import SHAPES
from tests.samples import attitude, build, command_long, frame, heartbeat, read
from uavlinkd.mavlink import headers
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.headers import Header

M = mavlink


def takeoff(target_system: int = 7, target_component: int = 9, *, version: int = 2) -> Frame:
    return command_long(22, 42, (target_system, target_component), version=version)


@pytest.mark.parametrize(
    ("one", "facts"),
    [
        (heartbeat(system=42), (0, 0, 0, None)),  # goes to all
        (takeoff(version=1), (76, 7, 9, 22)),
        (takeoff(), (76, 7, 9, 22)),
        (frame(M.MAVLink_mission_item_int_message(5, 6, 0, 3, 185, 0, 1, 1, 0, 0, 0, 0, 0, 0), 42), (73, 5, 6, 185)),
        (frame(M.MAVLink_command_ack_message(22, 0), 42), (77, 0, 0, None)),  # names a command and asks for none
        (
            frame(M.MAVLink_manual_control_message(9, 1, 2, 3, 4, 5), 42),
            (69, 9, 0, None),
        ),  # its field is just "target"
    ],
)
def test_header_has_message_target_and_command(one: Frame, facts: tuple[int, int, int, int | None]) -> None:
    """They are read where the message's layout has them, in both versions."""
    header = one.header
    assert (header.msgid, header.target_system, header.target_component, header.command) == facts
    assert (header.system, header.component, header.is_known) == (42, 1, True)
    assert header.is_mavlink1 == (one.raw[0] == 0xFE)


@pytest.mark.parametrize("kept", range(34))
def test_fields_cut_from_the_payloads_end_are_zero(kept: int) -> None:
    """MAVLink 2 cuts trailing zeros: whatever is cut reads as 0, down to half a command number."""
    header = read(build(76, (bytes(28) + b"\x34\x12\x07\x09\x01")[:kept])).header
    command = 0x1234 if kept >= 30 else 0x34 if kept == 29 else 0
    targets = 7 if kept > 30 else 0, 9 if kept > 31 else 0
    assert (header.command, header.target_system, header.target_component) == (command, *targets)
    assert header.is_known


def test_frames_that_say_the_same_share_a_header() -> None:
    """One object for each sender and message, for each target and command, for each version."""
    assert attitude().header is header_of(SHAPES["v2 signed"])
    assert takeoff().header is takeoff().header
    frames = [attitude(), attitude(version=1), attitude(1, 2), heartbeat(), takeoff(), takeoff(7, 8), takeoff(6, 9)]
    others = [one.header for one in frames]
    assert len(set(map(id, others))) == len(others)


def header_of(raw: bytes) -> Header:
    return read(raw).header


def test_ground_station_may_address_many_targets_in_turn() -> None:
    """A second round over 250 systems gets the headers of the first: routing and policy have decided about them."""
    rounds = [[takeoff(target).header for target in range(1, 251)] for _ in range(2)]
    assert all(first is second for first, second in zip(*rounds, strict=True))


def test_memory_of_headers_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Invented senders and targets fill no memory. The oldest headers are forgotten, not all of them."""
    monkeypatch.setattr(headers, "MAX_SENDER_MESSAGES", 8)
    monkeypatch.setattr(headers, "MAX_TARGETED_HEADERS", 8)
    headers.sender_messages.clear()
    for system in range(1, 100):
        assert heartbeat(system=system).header.system == system
        assert len(headers.sender_messages) <= 8
    assert heartbeat(system=95).header is heartbeat(system=95).header
    headers.targeted_headers.clear()
    latest = {target: takeoff(target).header for target in range(1, 100)}
    assert len(headers.targeted_headers) == 8
    assert [(header.target_system, header.command) for header in latest.values()] == [(n, 22) for n in range(1, 100)]
    assert all(takeoff(target).header is latest[target] for target in range(92, 100))
