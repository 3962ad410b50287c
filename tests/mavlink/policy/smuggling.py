"""Hidden frames for the tests of delivered streams."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from fastcrc.crc16 import mcrf4xx

from tests.samples import build
from uavlinkd.mavlink.dialect import MESSAGES, OTHER_EXTRAS
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import Source

ATTITUDE, PARAM_REQUEST_READ, SET_MODE, COMMAND_LONG, HEARTBEAT = 30, 20, 11, 76, 0
HOME_POSITION, SETUP_SIGNING = 242, 256


v2 = build
v1 = partial(build, version=1)


def hidden_header(msgid: int, payload_bytes: int, system: int = 255) -> bytes:
    """The header of a hidden frame. It fits into a signature."""
    return bytes((0xFD, payload_bytes, 0, 0, 7, system, 1)) + msgid.to_bytes(3, "little")


def split_over(middle: bytes = b"", msgid: int = COMMAND_LONG, system: int = 1) -> tuple[bytes, bytes]:
    """Two ATTITUDE frames. A frame of system 255 begins in the signature of one and ends in the payload of the next.

    `middle` is between them.
    """
    header = hidden_header(msgid, len(middle) + 10 + 26)
    opening = v2(ATTITUDE, bytes(27) + b"\1", system, signature=bytes(3) + header)
    payload = bytes(range(26))
    begun = middle + v2(ATTITUDE, payload + b"\1\1", system)[: 10 + 26]
    crc = mcrf4xx(header[1:] + begun + bytes((MESSAGES[msgid][1],))).to_bytes(2, "little")
    return opening, v2(ATTITUDE, payload + crc, system)


def source(role: str = "swarm-member", systems: object = (1,), **more: object) -> Source:
    """A policy of a peer with this role and these systems."""
    return Source(role, Policy({"role": role, "system_ids": systems, **more}).incoming)


def valid_frames(stream: bytes, *, any_extra: bool = False) -> Iterator[tuple[int, bytes]]:
    """Every offset at which a valid frame begins, and the frame without its signature. The simplest search."""
    for start in range(len(stream)):
        if stream[start] == 0xFE:
            header, id_at, id_bytes = 6, start + 5, 1
        elif stream[start] == 0xFD and stream[start + 2 : start + 3] in (b"\0", b"\1"):
            header, id_at, id_bytes = 10, start + 7, 3
        else:
            continue
        end = start + header + int.from_bytes(stream[start + 1 : start + 2]) + 2
        if end > len(stream) or len(stream) < start + header:
            continue
        msgid = int.from_bytes(stream[id_at : id_at + id_bytes], "little")
        extras = {0, *OTHER_EXTRAS.get(msgid, ())} | ({MESSAGES[msgid][1]} if msgid in MESSAGES else set())
        covered, crc = stream[start + 1 : end - 2], stream[end - 2 : end]
        for extra in range(256) if any_extra else extras:
            if mcrf4xx(covered + bytes((extra,))).to_bytes(2, "little") == crc:
                yield start, stream[start:end]
                break
