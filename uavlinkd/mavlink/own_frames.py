"""MAVLink 2 frames that the daemon makes itself."""

from __future__ import annotations

from struct import Struct
from typing import Final

from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink.dialect import facts
from uavlinkd.mavlink.frames import MAVLINK2

_HEADER: Final = Struct("<BBBBBBHB")
"""Length, incompat_flags, compat_flags, sequence, system, component, message id in 16 and 8 bits."""
_CRC: Final = Struct("<H")


def pack(msgid: int, payload: bytes, seq: int, system: int, component: int) -> bytes:
    """A frame of a message of the dialect. MAVLink 2 cuts off zero bytes at the end of a payload."""
    definition = facts(msgid)
    assert definition is not None, "the daemon sends only messages of the dialect"
    body = payload.rstrip(b"\0") or b"\0"
    header = _HEADER.pack(len(body), 0, 0, seq % 256, system, component, msgid & 0xFFFF, msgid >> 16)
    covered = header + body
    return bytes((MAVLINK2,)) + covered + _CRC.pack(mcrf4xx(covered + bytes((definition.crc_extra,))))
