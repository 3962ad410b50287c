"""A plain search for MAVLink frames at every offset of a stream: the evaluation's judge of what a client was sent.

It shares nothing with the daemon's filter but the tables of messages and the policies. MAVLink's own parsers judge in
`tests/mavlink/parsers`, where there is a C compiler.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fastcrc.crc16 import mcrf4xx

from uavlinkd.lab.evaluation.hidden_frames import SIGNATURE_BYTES, crc_extra
from uavlinkd.mavlink.dialect_table import OTHER_EXTRAS
from uavlinkd.mavlink.frames import MAVLINK1, MAVLINK2, parse_frame
from uavlinkd.mavlink.policy.gate import Gate


def frames_at_every_offset(stream: bytes) -> Iterator[tuple[int, bytes]]:
    """Where each valid frame begins, and the frame without its signature. MAVLink 1 may begin with 0xFD, too."""
    for at, byte in enumerate(stream):
        if byte in (MAVLINK1, MAVLINK2):
            raw = _frame(bytes((MAVLINK1,)) + stream[at + 1 : at + 263], 6)
            if raw:
                yield at, raw
        if byte == MAVLINK2:
            raw = _frame(stream[at : at + 267], 10)
            if raw and raw[2] <= 1:
                yield at, raw


def _frame(data: bytes, header_bytes: int) -> bytes:
    """The frame at the start of these bytes; none: empty."""
    end = header_bytes + data[1] + 2 if len(data) > header_bytes else len(data) + 1
    if end > len(data):
        return b""
    msgid = data[5] if header_bytes == 6 else int.from_bytes(data[7:10], "little")
    for extra in {0, crc_extra(msgid), *OTHER_EXTRAS.get(msgid, ())}:
        if mcrf4xx(data[1 : end - 2] + bytes((extra,))).to_bytes(2, "little") == data[end - 2 : end]:
            return data[:end]
    return b""


def forbidden_frames(stream: bytes, delivered: Sequence[tuple[int, bytes, Gate]]) -> list[bytes]:
    """The frames in a stream that policy refuses from a source of their bytes.

    ``delivered``: offset and bytes of each frame that the daemon delivered, and what its source may send.
    """
    starts = {at: raw for at, raw, _ in delivered}
    found = []
    for at, raw in frames_at_every_offset(stream):
        if starts.get(at, b"").startswith(raw) or _is_unreachable(stream, at, raw):
            continue
        gates = [gate for begin, part, gate in delivered if begin < at + len(raw) and at < begin + len(part)]
        whole = raw + bytes(SIGNATURE_BYTES) if raw[0] == MAVLINK2 and raw[2] else raw
        frame = parse_frame(whole)
        if frame is None or not all(gate.permits(frame) for gate in gates):
            found.append(raw)
    return found


def _is_unreachable(stream: bytes, at: int, raw: bytes) -> bool:
    """Whether no MAVLink 1 frame, valid or not, ends with the 0xFD that a MAVLink 1 frame begins with."""
    if raw[0] != MAVLINK1 or stream[at] != MAVLINK2:
        return False
    first = max(0, at - 262)
    return not any(
        stream[begin] in (MAVLINK1, MAVLINK2) and begin + 7 + stream[begin + 1] == at for begin in range(first, at)
    )
