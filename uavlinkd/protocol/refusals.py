"""Refusal reports: each end tells the other which of its frames a policy refuses, as counts. README.md, section 12.

A report is a claim of the peer. The core keeps it for people to read and never acts on it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from uavlinkd.protocol import constants as c

REFUSAL_REPORT = 6
_ENTRY = struct.Struct(">BHHBI")  # message id 8 + 16, command, reason, total
LARGEST_REPORT = 1 + c.REFUSALS_PER_REPORT * _ENTRY.size
"""Bytes of a report with as many entries as it may have."""
MAX_TOTAL = 2**32 - 1


class Refused(NamedTuple):
    """Frames of one kind that were refused for one reason."""

    message: int
    command: int  # 0 without one
    reason: int  # its code in README.md
    total: int  # so far, at most :data:`MAX_TOTAL`


class RefusalReport(NamedTuple):
    """The control record: type 6, then 1 to :data:`c.REFUSALS_PER_REPORT` entries."""

    entries: tuple[Refused, ...]

    def encode(self) -> bytes:
        """The type, and ten bytes for each entry."""
        packed = (
            _ENTRY.pack(message >> 16, message & 0xFFFF, command, reason, total)
            for message, command, reason, total in self.entries
        )
        return bytes((REFUSAL_REPORT,)) + b"".join(packed)


def parse_report(payload: bytes) -> RefusalReport | None:
    """The report in a payload that begins with its type; None if the length fits no number of entries."""
    count, rest = divmod(len(payload) - 1, _ENTRY.size)
    if rest or not 1 <= count <= c.REFUSALS_PER_REPORT:
        return None
    rows = _ENTRY.iter_unpack(payload[1:])
    return RefusalReport(tuple(Refused(high << 16 | low, *others) for high, low, *others in rows))


Kind = tuple[int, int, int]
"""Message id, command and reason."""


@dataclass(slots=True)
class _Total:
    total: int
    sends_left: int


class OwnRefusals:
    """What this end refuses of a peer's frames, and which of it to report next.

    Counts are totals, so a report can be repeated, and a lost one costs nothing once the next one arrives.
    """

    __slots__ = ("_reported_at", "_totals")

    def __init__(self) -> None:
        self._totals: dict[Kind, _Total] = {}  # the one that changed longest ago first
        self._reported_at = -c.NEVER

    def update(self, changed: Iterable[Refused]) -> None:
        """Set the totals of the kinds that changed. Each change is reported :data:`c.REFUSALS_SENDS` times."""
        for message, command, reason, total in changed:
            key = message, command, reason
            capped, before = min(total, MAX_TOTAL), self._totals.get(key)
            if before is not None and before.total == capped:
                continue
            self._totals.pop(key, None)
            self._totals[key] = _Total(capped, c.REFUSALS_SENDS)
            if len(self._totals) > c.REFUSALS_KEPT:
                del self._totals[next(iter(self._totals))]

    def take(self, now: float) -> RefusalReport | None:
        """The next report; None while there is nothing new, or the last one was sent too recently."""
        if now < self._reported_at + c.REFUSALS_INTERVAL_S:
            return None
        due = [(key, total) for key, total in self._totals.items() if total.sends_left][: c.REFUSALS_PER_REPORT]
        if not due:
            return None
        self._reported_at = now
        for _, total in due:
            total.sends_left -= 1
        return RefusalReport(tuple(Refused(*key, total.total) for key, total in due))


@dataclass(frozen=True, slots=True)
class Claim:
    """One entry of a peer's reports, and when its count changed last."""

    refused: Refused
    changed_at: float


class RefusalClaims:
    """What a peer claims to refuse of this end's frames: the kinds that it reported last, in bounded memory."""

    __slots__ = ("_claims",)

    def __init__(self) -> None:
        self._claims: dict[Kind, Claim] = {}  # the one that changed longest ago first

    def note(self, report: RefusalReport, now: float) -> None:
        """Keep the entries of a report. A repeated entry changes nothing."""
        for refused in report.entries:
            key = refused[:3]
            before = self._claims.get(key)
            if before is not None and before.refused == refused:
                continue
            self._claims.pop(key, None)
            self._claims[key] = Claim(refused, now)
            if len(self._claims) > c.REFUSALS_KEPT:
                del self._claims[next(iter(self._claims))]

    def recent(self) -> list[Claim]:
        """The claims, the one that changed last first."""
        return list(reversed(self._claims.values()))
