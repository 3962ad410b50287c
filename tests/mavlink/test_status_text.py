"""STATUSTEXT: what pymavlink reads of the daemon's texts."""

from __future__ import annotations

import os
from typing import Any

import pytest

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.dialect import facts
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.mavlink.own_frames import pack
from uavlinkd.mavlink.status_text import COMPONENT, Note, StatusTextSource, TextSeverity


def decoded(raw: bytes) -> Any:
    """The one message in these bytes."""
    (message,) = mavlink.MAVLink(None).parse_buffer(raw)
    return message


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("link to drone1 lost", "link to drone1 lost"),
        ("x" * 50, "x" * 50),
        ("x" * 51, "x" * 50),
        ("dróne", "dr?ne"),
        ("", ""),
    ],
)
def test_pymavlink_reads_the_text(text: str, shown: str) -> None:
    """Text, severity and sender; a longer text is cut, and it is ASCII."""
    raw = StatusTextSource().frame(Note(TextSeverity.CRITICAL, text, 7))
    message = decoded(raw)
    assert (message.get_type(), message.text, message.severity) == (
        "STATUSTEXT",
        shown,
        mavlink.MAV_SEVERITY_CRITICAL,
    )
    assert (message.id, message.chunk_seq) == (0, 0)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (7, mavlink.MAV_COMP_ID_UDP_BRIDGE)
    assert COMPONENT == mavlink.MAV_COMP_ID_UDP_BRIDGE
    (frame,) = split_datagram(raw, SplitCounters())
    assert frame.header.is_known


def test_severities_are_those_of_mavlink() -> None:
    """By their names."""
    for severity in TextSeverity:
        assert severity == getattr(mavlink, f"MAV_SEVERITY_{severity.name}")


def test_each_vehicle_has_a_sequence() -> None:
    """A ground station counts lost messages by sender: numbers of one system have no gaps."""
    source = StatusTextSource()
    notes = [Note(TextSeverity.NOTICE, "text", system) for system in (1, 2) * 300]
    messages = [decoded(source.frame(note)) for note in notes]
    for system in (1, 2):
        numbers = [message.get_seq() for message in messages if message.get_srcSystem() == system]
        assert numbers == [number % 256 for number in range(300)]


def test_crc_extra_and_truncation() -> None:
    """CRC_EXTRA 83 as MAVLink defines it; of a payload of zeros one byte is left."""
    definition = facts(253)
    assert definition is not None
    assert definition.crc_extra == 83
    assert pack(253, bytes(51), 0, 1, 1)[1] == 1
