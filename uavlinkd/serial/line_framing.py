"""Datagrams on a byte stream: the framing of serial networks (section 20 of ``uavlinkd/protocol/README.md``).

::

    0x00 | COBS(datagram | CRC-16 of the datagram, big-endian) | 0x00

COBS (Consistent Overhead Byte Stuffing) removes the byte 0x00 from its input, so 0x00 always ends a datagram. The one
in front ends noise from before it. The CRC is CRC-16/CCITT with the initial value 0xFFFF. It only keeps line noise
out of the core's counters: envelopes have their own tags. Sans-IO.

A SiK modem with ``MAVLINK=1`` or ``2`` puts a RADIO_STATUS frame a second between the bytes that it received by radio
(message 109; old firmware 166)::

    MAVLink 1   0xFE | 9 | seq | system | component | message | payload 9 | checksum 2            17 bytes
    MAVLink 2   0xFD | 9 | 0 | 0 | seq | system | component | message 3 | payload 9 | checksum 2  21 bytes
    payload     rxerrors u16 | fixed u16 | rssi | remrssi | txbuf | noise | remnoise

It takes part in no security: any device on the line can forge it. People see it, and this end sends more slowly while
it says that the modem's send buffer is full.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections import Counter
from enum import StrEnum
from struct import Struct
from typing import Final

from cobs import cobs
from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink.frames import MAVLINK1, MAVLINK2

DELIMITER: Final = b"\0"
CRC_BYTES: Final = 2
MAX_DATAGRAM: Final = 2048  # the longest datagram on a line: more than the longest handshake message
MAX_ENCODED: Final = MAX_DATAGRAM + CRC_BYTES + (MAX_DATAGRAM + CRC_BYTES + 253) // 254
"""The longest datagram in COBS, without delimiters. A receiver holds at most this and one chunk."""

REPORT_STARTS: Final = bytes((MAVLINK1, MAVLINK2))  # a report starts with one of these bytes
_CRC_EXTRA: Final = {109: 185, 166: 21}  # by message: RADIO_STATUS, and RADIO of old firmware
_HEADERS: Final = {MAVLINK1: (17, 5, {1: 9}), MAVLINK2: (21, 7, {1: 9, 2: 0, 3: 0, 8: 0, 9: 0})}
"""By first byte: length of a report, place of the message, and the bytes that have one value, by their places."""
_FIGURES: Final = Struct("<HH5B")
RADIO_FIGURES: Final = ("rxerrors", "fixed", "rssi", "remrssi", "txbuf", "noise", "remnoise")
"""What a modem says about the radio link. Units as in MAVLink: rssi and noise as the modem counts them; ``txbuf`` is
the free room in its send buffer, in per cent. 255 in ``rssi`` and others: unknown."""


def report_bytes(data: bytes, at: int) -> int | None:
    """The length of the report that begins at a place; 0 if no report begins there; None if too few bytes follow."""
    if data[at] not in _HEADERS:
        return 0
    (size, message_at, fixed), left = _HEADERS[data[at]], len(data) - at
    if any(place < left and data[at + place] != value for place, value in fixed.items()):
        return 0
    if message_at < left and data[at + message_at] not in _CRC_EXTRA:
        return 0
    if left < size:
        return None
    extra = _CRC_EXTRA[data[at + message_at]]
    checksum = mcrf4xx(data[at + 1 : at + size - 2] + bytes((extra,)))
    return size if int.from_bytes(data[at + size - 2 : at + size], "little") == checksum else 0


def parse_report(frame: bytes) -> dict[str, int]:
    """The figures of a whole report, by :data:`RADIO_FIGURES`."""
    figures = _FIGURES.unpack_from(frame, len(frame) - _FIGURES.size - CRC_BYTES)
    return dict(zip(RADIO_FIGURES, figures, strict=True))


class Noise(StrEnum):
    """Why a piece between two delimiters is not a datagram."""

    BAD_COBS = "bad_cobs"
    BAD_CRC = "bad_crc"
    TOO_LONG = "too_long"


def encode(datagram: bytes) -> bytes:
    """The bytes of a datagram on the line: 5 more than its own, up to 252, and 6 more up to 506.

    Raises ValueError if it is longer than :data:`MAX_DATAGRAM`.
    """
    if len(datagram) > MAX_DATAGRAM:
        raise ValueError(f"a datagram of {len(datagram)} bytes is too long for a line")
    return DELIMITER + bytes(cobs.encode(datagram + _crc(datagram))) + DELIMITER


def _crc(datagram: bytes) -> bytes:
    return crc_hqx(datagram, 0xFFFF).to_bytes(CRC_BYTES, "big")


class LineDecoder:
    """Finds the datagrams in a byte stream, however it is cut into chunks. Any bytes are accepted.

    After an error, the next delimiter ends what is broken. Reports of the modem between datagrams are skipped. A
    datagram into which the modem put a report is lost.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._is_skipping = False  # up to the next delimiter: what precedes it is too long
        self.datagrams = 0  # how many arrived whole
        self.discarded = Counter[Noise](dict.fromkeys(Noise, 0))
        """Pieces between two delimiters that are not a datagram."""
        self.discarded_bytes = Counter[Noise](dict.fromkeys(Noise, 0))  # their bytes
        self.reports = 0  # reports of the modem
        self.report: dict[str, int] | None = None  # the last one

    @property
    def line_noise(self) -> int:
        return self.discarded.total()

    @property
    def pending_bytes(self) -> int:
        """Bytes that wait for more."""
        return len(self._rest)

    def feed(self, chunk: bytes) -> list[bytes]:
        """The datagrams that these bytes complete. The cost is linear for chunks of a few kilobytes."""
        datagrams: list[bytes] = []
        data, at = self._rest + chunk, 0
        while at < len(data):
            if not self._is_skipping and data[at] in REPORT_STARTS:
                # No datagram begins like a report: its first byte, the second one here, would be 9.
                size = report_bytes(data, at)
                if size is None:
                    break
                if size:
                    self._note(data[at : at + size])
                    at += size
                    continue
            end = data.find(0, at)
            if end < 0:
                break
            piece = data[at:end]
            if self._is_skipping:  # the piece is counted already
                self._is_skipping = False
                self.discarded_bytes[Noise.TOO_LONG] += len(piece)
            elif piece:
                result = _decode(piece)
                if isinstance(result, Noise):
                    self._discard(result, len(piece))
                else:
                    datagrams.append(result)
            at = end + 1
        self._keep(data[at:])
        self.datagrams += len(datagrams)
        return datagrams

    def reset(self) -> None:
        """Forget the bytes that wait: the device was closed."""
        self._rest, self._is_skipping = b"", False

    def _discard(self, noise: Noise, size: int) -> None:
        self.discarded[noise] += 1
        self.discarded_bytes[noise] += size

    def _note(self, frame: bytes) -> None:
        self.reports += 1
        self.report = parse_report(frame)

    def _keep(self, rest: bytes) -> None:
        """Bytes wait for a delimiter, or for the rest of a report."""
        if self._is_skipping:
            self.discarded_bytes[Noise.TOO_LONG] += len(rest)
            rest = b""
        elif len(rest) > MAX_ENCODED and DELIMITER not in rest:
            self._is_skipping = True
            self._discard(Noise.TOO_LONG, len(rest))
            rest = b""
        self._rest = rest


def _decode(piece: bytes) -> bytes | Noise:
    """The datagram between two delimiters, or why it is not one."""
    if len(piece) > MAX_ENCODED:
        return Noise.TOO_LONG
    try:
        content = bytes(cobs.decode(piece))
    except cobs.DecodeError:
        return Noise.BAD_COBS
    datagram, crc = content[:-CRC_BYTES], content[-CRC_BYTES:]
    if len(content) < CRC_BYTES or crc != _crc(datagram):
        return Noise.BAD_CRC
    return datagram if len(datagram) <= MAX_DATAGRAM else Noise.TOO_LONG
