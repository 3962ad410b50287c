"""A second implementation of the control records, written from the specification alone, as `independent` is."""

from __future__ import annotations

import struct
from typing import NamedTuple


def echo_request(token: int, received: int = 0, expected: int = 0) -> bytes:
    """Section 12."""
    return struct.pack(">BIII", 1, token, received, expected)


def echo_reply(request: bytes, fresh: int, received: int = 0, expected: int = 0) -> bytes:
    """Sections 11 and 12: ``fresh`` is of the session that carried the request."""
    kind, token, _, _ = struct.unpack(">BIII", request)
    assert kind == 1
    return struct.pack(">BIIII", 2, token, received, expected, fresh)


class Probe(NamedTuple):
    """Section 15."""

    question: int = 0
    answer: int = 0
    sent: int = 0
    received: int = 0
    unused: int = 65535
    frames: bytes = b""
    padding: bytes = b""

    def encode(self) -> bytes:
        flags = 1 if self.frames else 2 if self.padding else 0
        record = struct.pack(">BBIIIIH", 3, flags, *self[:5]) + (bytes(2) if self.question else b"")
        return record + self.frames + self.padding


def read_probe(payload: bytes) -> Probe:
    """Section 15: a probe, and what follows it."""
    kind, flags, question, answer, sent, received, unused = struct.unpack(">BBIIIIH", payload[:20])
    assert kind == 3
    assert question or answer
    rest = payload[20:]
    if question:
        assert rest[:2] == bytes(2)
        rest = rest[2:]
    assert bool(rest) == (flags in (1, 2))
    frames, padding = (rest, b"") if flags == 1 else (b"", rest)
    return Probe(question, answer, sent, received, unused, frames, padding)


def refusal_report(*entries: tuple[int, int, int, int]) -> bytes:
    """Section 12: each entry is message id, command, reason and total."""
    rows = (m.to_bytes(3, "big") + struct.pack(">HBI", *rest) for m, *rest in entries)
    return b"\x06" + b"".join(rows)
