"""Problem reports: each end tells the other its own present problems, as codes. README.md, section 12.

A report is a claim of the peer about itself. The core keeps it for people to read and never acts on it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from uavlinkd.protocol import constants as c

PROBLEM_REPORT = 8
LARGEST_PROBLEM_REPORT = 1 + c.PROBLEMS_PER_REPORT


class ProblemReport(NamedTuple):
    """The control record: type 8, then 0 to :data:`c.PROBLEMS_PER_REPORT` ascending codes of one byte."""

    codes: tuple[int, ...]

    def encode(self) -> bytes:
        """The type, and a byte for each code."""
        return bytes((PROBLEM_REPORT, *self.codes))


def parse_problem_report(payload: bytes) -> ProblemReport | None:
    """The report in a payload that begins with its type; None if it has too many codes, or they do not ascend."""
    codes = tuple(payload[1:])
    if len(codes) > c.PROBLEMS_PER_REPORT or codes != tuple(sorted(set(codes))):
        return None
    return ProblemReport(codes)


class ProblemClaim(NamedTuple):
    """The codes of a peer's newest report, and when it arrived."""

    codes: tuple[int, ...]
    received_at: float


class OwnProblems:
    """When to report this end's problems to a peer."""

    __slots__ = ("_reported", "_reported_at", "_sends_left")

    def __init__(self) -> None:
        self._reported: tuple[tuple[int, ...], int] = (), -1
        self._reported_at = -c.NEVER
        self._sends_left = 0

    def take(self, codes: Iterable[int], session: int, now: float) -> ProblemReport | None:
        """The next report: after a change or new keys, twice; while a problem lasts, once a minute.

        ``session``: a number that no session before had. A generation may come again: the peer may have restarted.
        """
        if now < self._reported_at + c.REFUSALS_INTERVAL_S:
            return None
        present = tuple(sorted(set(codes))[: c.PROBLEMS_PER_REPORT])
        if (present, session) != self._reported:
            self._reported, self._sends_left = (present, session), c.REFUSALS_SENDS
        elif not self._sends_left and present and now >= self._reported_at + c.PROBLEMS_INTERVAL_S:
            self._sends_left = 1
        if not self._sends_left:
            return None
        self._sends_left -= 1
        self._reported_at = now
        return ProblemReport(present)
