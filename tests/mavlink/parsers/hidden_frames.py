"""Builds frames that hide another frame: in payloads, signatures and checksums, and across several frames.

A receiver that loses synchronisation between two frames continues inside one of them. No policy checks what it
accepts there, because the daemon reads frames one after another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.frames import MAVLINK1, MAVLINK2

SIGNATURE_BYTES = 13
_STEP = tuple(mcrf4xx(bytes([byte]), 0) for byte in range(256))
_INDEX_OF_HIGH = {step >> 8: index for index, step in enumerate(_STEP)}  # each high byte occurs once


@dataclass(slots=True)
class Carrier:
    """A frame whose payload, sequence number and signature its sender chooses."""

    msgid: int
    payload: bytearray
    system: int
    component: int = 1
    version: int = 2
    seq: int = 0
    compat: int = 0
    signature: bytearray = field(default_factory=bytearray)
    """13 bytes, or empty if the frame is not signed."""
    extra: int | None = None
    """CRC_EXTRA; None for that of the definition."""
    checksum_ends_in: int | None = None
    """The last byte of the checksum; the last two bytes of the payload are computed for it."""

    @property
    def payload_at(self) -> int:
        """Offset of the payload in the frame."""
        return 10 if self.version == 2 else 6

    @property
    def size(self) -> int:
        """Length of the frame in bytes."""
        return self.payload_at + len(self.payload) + 2 + len(self.signature)

    def build(self) -> bytes:
        header = self._header()
        extra = bytes((crc_extra(self.msgid) if self.extra is None else self.extra,))
        if self.checksum_ends_in is not None and len(self.payload) >= 2:
            known = mcrf4xx(header[1:] + self.payload[:-2])
            wanted = _before(self.checksum_ends_in << 8 | self.seq, extra[0])
            self.payload[-2:] = _tail(known, wanted)
        body = header[1:] + self.payload
        return header[:1] + body + mcrf4xx(body + extra).to_bytes(2, "little") + self.signature

    def _header(self) -> bytes:
        if self.version == 1:
            return bytes((MAVLINK1, len(self.payload), self.seq, self.system, self.component, self.msgid))
        flags = 1 if self.signature else 0
        head = (MAVLINK2, len(self.payload), flags, self.compat, self.seq, self.system, self.component)
        return bytes(head) + self.msgid.to_bytes(3, "little")


def crc_extra(msgid: int) -> int:
    """The CRC_EXTRA of a message's definition; 0 for a message without one, as in MAVLink's C library."""
    row = MESSAGES.get(msgid)
    return row[1] if row else 0


def frame(
    msgid: int, payload: bytes, system: int, component: int = 1, *, version: int = 2, extra: int | None = None
) -> bytes:
    """A genuine unsigned frame. MAVLink 1 fills the payload with zeros; MAVLink 2 keeps it as it is."""
    row = MESSAGES.get(msgid)
    if version == 1 and row is not None:
        payload = payload.ljust(row[2], b"\0")
    return Carrier(msgid, bytearray(payload), system, component, version, extra=extra).build()


def hide(carriers: Sequence[Carrier], hidden: bytes, at: int, extra: int | None = None) -> list[bytes]:
    """Write ``hidden`` at offset ``at`` of the carriers' stream, and return the carriers' frames.

    Only bytes that the senders can choose are written; the other bytes of the hidden frame stay as they are. Its
    checksum is computed for the result. ``extra`` is its CRC_EXTRA; None for that of the definition. The hidden frame
    is valid if its header and its checksum are at bytes that the senders can choose.
    """
    checksum_at = at + len(hidden) - 2
    if extra is None:
        extra = crc_extra(msgid_of(hidden))
    stream = bytearray()
    frames = []
    for carrier in carriers:
        begin = len(stream)
        for name, offset, count in _free(carrier):
            first, last = max(at, begin + offset), min(checksum_at, begin + offset + count)
            if first < last:
                _write(carrier, name, first - begin - offset, hidden[first - at : last - at])
        if begin <= checksum_at < begin + carrier.size:
            done = stream + carrier.build()  # all bytes before the checksum are final
            fits = mcrf4xx(bytes(done[at + 1 : checksum_at]) + bytes((extra,))).to_bytes(2, "little")
            for name, offset, count in _free(carrier):
                place = checksum_at - begin - offset
                if place >= 0 and place + 2 <= count:
                    _write(carrier, name, place, fits)
        frames.append(carrier.build())
        stream += frames[-1]
    return frames


def msgid_of(raw: bytes) -> int:
    return raw[5] if raw[0] == MAVLINK1 else int.from_bytes(raw[7:10], "little")


def _free(carrier: Carrier) -> tuple[tuple[str, int, int], ...]:
    """The bytes of a frame that its sender chooses: what they are, their offset and their count."""
    payload = ("payload", carrier.payload_at, len(carrier.payload))
    if carrier.version == 1:
        return ("seq", 2, 1), payload
    signature = ("signature", carrier.payload_at + len(carrier.payload) + 2, len(carrier.signature))
    return ("compat", 3, 1), ("seq", 4, 1), payload, signature


def _write(carrier: Carrier, name: str, place: int, data: bytes) -> None:
    if name in ("seq", "compat"):
        setattr(carrier, name, data[0])
    else:
        getattr(carrier, name)[place : place + len(data)] = data


def _before(after: int, byte: int) -> int:
    """The checksum that becomes ``after`` with one more byte."""
    index = _INDEX_OF_HIGH[after >> 8]
    return ((after ^ _STEP[index]) & 0xFF) << 8 | (index ^ byte)


def _tail(known: int, wanted: int) -> bytes:
    """The two bytes that turn the checksum ``known`` into ``wanted``."""
    last = _INDEX_OF_HIGH[wanted >> 8]
    high = (wanted ^ _STEP[last]) & 0xFF  # of the checksum after the first byte
    first = _INDEX_OF_HIGH[high]
    middle = (known >> 8) ^ _STEP[first]
    return bytes((first ^ (known & 0xFF), last ^ (middle & 0xFF)))
