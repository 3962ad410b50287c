"""STATUSTEXT for a local ground station: what the daemon has to say to the pilot about a link.

QGroundControl shows a text under the vehicle that sent it, and ignores other system ids (Vehicle,
``_mavlinkMessageReceived``; only RADIO_STATUS is exempt). So a text about a link has the system id of the vehicle
behind it. The component id is the daemon's own, MAV_COMP_ID_UDP_BRIDGE, so the vehicle's own texts and their sequence
numbers are not disturbed, and a pilot can tell both apart.

A text is at most 50 ASCII characters: clients of MAVLink 1 know no longer ones.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

from uavlinkd.mavlink.dialect import IDS
from uavlinkd.mavlink.frames import pack

COMPONENT: Final = 240
TEXT_BYTES: Final = 50
_MSGID: Final = IDS["STATUSTEXT"]


class TextSeverity(IntEnum):
    """MAV_SEVERITY. A smaller value is more severe."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5


class Note(NamedTuple):
    """One text about the link to a vehicle."""

    severity: TextSeverity
    text: str
    system: int
    """Of the vehicle."""


class StatusTextSource:
    """STATUSTEXT frames for one endpoint, with a MAVLink sequence for each vehicle."""

    __slots__ = ("_sequences",)

    def __init__(self) -> None:
        self._sequences: dict[int, int] = {}

    def frame(self, note: Note) -> bytes:
        """The next frame, MAVLink 2."""
        seq = self._sequences.get(note.system, 0)
        self._sequences[note.system] = (seq + 1) % 256
        text = note.text.encode("ascii", "replace")[:TEXT_BYTES]
        return pack(_MSGID, bytes((note.severity,)) + text, seq, note.system, COMPONENT)
