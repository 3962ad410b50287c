"""Probes: one control record that asks along a path, answers, and reports what arrived. README.md, section 15."""

from __future__ import annotations

import struct
from typing import NamedTuple

PROBE = 3
_PROBE = struct.Struct(">BBIIIIH")
_ZERO = bytes(2)
ANSWER_BYTES = _PROBE.size
"""A probe that only answers: shorter, so that it fits under the longer header into the length of its question."""
QUESTION_BYTES = ANSWER_BYTES + len(_ZERO)
_UNUSED = 0xFFFF
_FRAMES, _PADDING = 1, 2
MAX_COUNT = 2**32 - 1


class Probe(NamedTuple):
    """A question, an answer, or both, and a report about the path that carries it."""

    question: int  # 0 without one
    answer: int  # the question that it answers; 0 without one
    sent: int  # datagrams of this session along this path, this one included
    received: int

    def encode(self, frames: bytes = b"", padding: int = 0) -> bytes:
        """The record, and behind it whole frames or ``padding`` bytes."""
        flags = _FRAMES if frames else _PADDING if padding else 0
        fields = self.question, self.answer, self.sent & MAX_COUNT, self.received & MAX_COUNT, _UNUSED
        record = _PROBE.pack(PROBE, flags, *fields) + (_ZERO if self.question else b"")
        return record + frames + bytes(padding)


def parse_probe(payload: bytes) -> tuple[Probe, bytes] | None:
    """The probe in a payload that begins with its type, and the frames behind it. None if it is invalid."""
    if len(payload) < ANSWER_BYTES:
        return None
    _, flags, question, answer, sent, received, _ = _PROBE.unpack_from(payload)
    size = QUESTION_BYTES if question else ANSWER_BYTES
    is_alone = len(payload) == size
    is_valid = (
        (question or answer)
        and flags in (0, _FRAMES, _PADDING)
        and len(payload) >= size
        and is_alone == (flags == 0)
        and payload[ANSWER_BYTES:size] == _ZERO[: size - ANSWER_BYTES]
    )
    if not is_valid:
        return None
    return Probe(question, answer, sent, received), payload[size:] if flags == _FRAMES else b""
