"""A search for MAVLink frames at every offset of a stream. It judges the bytes that a client received.

It shares only the message tables and the policies with the daemon's filter. `tests/mavlink/parsers` uses MAVLink's
own parsers, which need a C compiler.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fastcrc.crc16 import mcrf4xx

from uavlinkd.lab.evaluation.hidden_frames import SIGNATURE_BYTES, crc_extra
from uavlinkd.mavlink.dialect_table import OTHER_EXTRAS
from uavlinkd.mavlink.frames import MAVLINK1, MAVLINK2, parse_frame
from uavlinkd.mavlink.policy.gate import Gate


def frames_at_every_offset(stream: bytes) -> Iterator[tuple[int, bytes]]:
    """The offset of each valid frame, and the frame without its signature. MAVLink 1 may begin with 0xFD too."""
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
    """The frame at the start of these bytes; empty if there is no valid frame."""
    end = header_bytes + data[1] + 2 if len(data) > header_bytes else len(data) + 1
    if end > len(data):
        return b""
    msgid = data[5] if header_bytes == 6 else int.from_bytes(data[7:10], "little")
    for extra in {0, crc_extra(msgid), *OTHER_EXTRAS.get(msgid, ())}:
        if mcrf4xx(data[1 : end - 2] + bytes((extra,))).to_bytes(2, "little") == data[end - 2 : end]:
            return data[:end]
    return b""


def forbidden_frames(stream: bytes, delivered: Sequence[tuple[int, bytes, Gate]]) -> list[bytes]:
    """The frames in a stream that a policy of one of their sources refuses.

    ``delivered``: offset and bytes of each frame that the daemon delivered, and the policy of its source.
    """
    starts = {at: raw for at, raw, _ in delivered}
    forbidden = []
    for at, raw in frames_at_every_offset(stream):
        if starts.get(at, b"").startswith(raw) or _is_unreachable(stream, at, raw):
            continue
        gates = [gate for begin, part, gate in delivered if begin < at + len(raw) and at < begin + len(part)]
        whole = raw + bytes(SIGNATURE_BYTES) if raw[0] == MAVLINK2 and raw[2] else raw
        frame = parse_frame(whole)
        if frame is None or not all(gate.permits(frame) for gate in gates):
            forbidden.append(raw)
    return forbidden


def _is_unreachable(stream: bytes, at: int, raw: bytes) -> bool:
    """Whether a MAVLink 1 frame begins with a 0xFD that is not the end of another MAVLink 1 frame, valid or not."""
    if raw[0] != MAVLINK1 or stream[at] != MAVLINK2:
        return False
    first = max(0, at - 262)
    return not any(
        stream[begin] in (MAVLINK1, MAVLINK2) and begin + 7 + stream[begin + 1] == at for begin in range(first, at)
    )
