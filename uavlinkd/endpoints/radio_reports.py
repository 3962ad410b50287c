"""RADIO_STATUS frames that a modem puts between the bytes that it received by radio.

A SiK modem with ``MAVLINK=1`` or ``2`` sends one a second to its own host, in MAVLink 1 or 2 (message 109; old
firmware 166)::

    MAVLink 1   0xFE | 9 | seq | system | component | message | payload 9 | checksum 2            17 bytes
    MAVLink 2   0xFD | 9 | 0 | 0 | seq | system | component | message 3 | payload 9 | checksum 2  21 bytes
    payload     rxerrors u16 | fixed u16 | rssi | remrssi | txbuf | noise | remnoise

It takes part in no security: any device on the line can forge it. It is for people only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink.frames import MAVLINK1, MAVLINK2

REPORT_STARTS: Final = bytes((MAVLINK1, MAVLINK2))
"""A report starts with one of these bytes."""
_PAYLOAD_BYTES = 9
_CRC_EXTRA: Final = {109: 185, 166: 21}
"""By message: RADIO_STATUS, and RADIO of old firmware."""
_FIXED: Final = {MAVLINK1: {1: 9}, MAVLINK2: {1: 9, 2: 0, 3: 0, 8: 0, 9: 0}}
"""Bytes of the header with one value, by their places."""
_SIZES: Final = {MAVLINK1: 17, MAVLINK2: 21}
_MESSAGE_AT: Final = {MAVLINK1: 5, MAVLINK2: 7}


@dataclass(frozen=True, slots=True)
class RadioReport:
    """What a modem says about the radio link. Units as in MAVLink: rssi and noise as the modem counts them.

    ``txbuf``: free room in the modem's send buffer, in per cent. 255 in ``rssi`` and others: unknown.
    """

    rssi: int
    remrssi: int
    txbuf: int
    noise: int
    remnoise: int
    rxerrors: int
    fixed: int


def report_bytes(data: bytes, at: int) -> int | None:
    """The length of the report that begins at a place; 0 if no report begins there; None if too few bytes follow."""
    start = data[at]
    if start not in _SIZES:
        return 0
    size, left = _SIZES[start], len(data) - at
    for place, value in _FIXED[start].items():
        if place < left and data[at + place] != value:
            return 0
    message_at = _MESSAGE_AT[start]
    if message_at < left and data[at + message_at] not in _CRC_EXTRA:
        return 0
    if left < size:
        return None
    extra = _CRC_EXTRA[data[at + message_at]]
    checksum = mcrf4xx(data[at + 1 : at + size - 2] + bytes((extra,)))
    return size if int.from_bytes(data[at + size - 2 : at + size], "little") == checksum else 0


def parse_report(frame: bytes) -> RadioReport:
    """The figures of a whole report."""
    payload = frame[-2 - _PAYLOAD_BYTES : -2]
    rxerrors, fixed = (int.from_bytes(payload[at : at + 2], "little") for at in (0, 2))
    rssi, remrssi, txbuf, noise, remnoise = payload[4:]
    return RadioReport(rssi, remrssi, txbuf, noise, remnoise, rxerrors, fixed)
