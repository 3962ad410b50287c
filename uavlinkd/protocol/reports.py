"""Reports of one end to the other: which frames a policy refuses, and its own problems. README.md, section 12.

A report is a claim of the peer. The core keeps it for people to read and never acts on it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, NamedTuple, TypeVar

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.wire import ProblemReport, RefusalReport, Refused, Report

Kind = tuple[int, int, int]
"""Message id, command and reason of frames that are refused."""
K = TypeVar("K")
V = TypeVar("V")


class Repeated(Generic[K, V]):
    """Facts that are reported after each change, so often that a lost report costs nothing.

    Reports are :data:`c.REFUSALS_INTERVAL_S` apart. At most :data:`c.REFUSALS_KEPT` facts are kept: the one that
    changed longest ago is forgotten.
    """

    __slots__ = ("_facts", "_reported_at", "_sends_left")

    def __init__(self) -> None:
        self._facts: dict[K, V] = {}  # the one that changed longest ago first
        self._sends_left: dict[K, int] = {}
        self._reported_at = -c.NEVER

    def __len__(self) -> int:
        return len(self._facts)

    def set(self, key: K, fact: V) -> None:
        """Have a fact reported :data:`c.REFUSALS_SENDS` times, if it changed."""
        if self._facts.get(key) == fact:
            return
        self._facts.pop(key, None)
        self._facts[key], self._sends_left[key] = fact, c.REFUSALS_SENDS
        if len(self._facts) > c.REFUSALS_KEPT:
            oldest = next(iter(self._facts))
            del self._facts[oldest], self._sends_left[oldest]

    def repeat(self, key: K, now: float) -> None:
        """Have a fact reported once more, if the last report was :data:`c.PROBLEMS_INTERVAL_S` ago."""
        if now >= self._reported_at + c.PROBLEMS_INTERVAL_S:
            self._sends_left[key] = max(1, self._sends_left[key])

    def take(self, now: float) -> list[tuple[K, V]]:
        """The facts of the next report; none while nothing is new, or the last report was sent too recently."""
        if now < self._reported_at + c.REFUSALS_INTERVAL_S:
            return []
        due = [fact for fact in self._facts.items() if self._sends_left[fact[0]]][: c.REFUSALS_PER_REPORT]
        for key, _ in due:
            self._sends_left[key] -= 1
            self._reported_at = now
        return due


class OwnReports:
    """What this end reports to one peer."""

    __slots__ = ("_problems", "refusals")

    def __init__(self) -> None:
        self.refusals = Repeated[Kind, int]()
        """Totals of the peer's frames that are refused here."""
        self._problems = Repeated[None, tuple[tuple[int, ...], int]]()

    def update_refusals(self, changed: Iterable[Refused]) -> None:
        """Set the totals of the kinds that changed."""
        for message, command, reason, total in changed:
            self.refusals.set((message, command, reason), min(total, 2**32 - 1))

    def next_refusals(self, now: float) -> RefusalReport | None:
        """The next refusal report, if one is due."""
        due = self.refusals.take(now)
        return RefusalReport(tuple(Refused(*kind, total) for kind, total in due)) if due else None

    def next_problems(self, codes: Iterable[int], session: int, now: float) -> ProblemReport | None:
        """The next problem report, if one is due: after a change or new keys, and while a problem lasts.

        ``session``: a number that no session before had. A generation may come again: the peer may have restarted.
        """
        present = tuple(sorted(set(codes))[: c.PROBLEMS_PER_REPORT])
        self._problems.set(None, (present, session))
        if present:
            self._problems.repeat(None, now)
        return ProblemReport(present) if self._problems.take(now) else None


class Claim(NamedTuple):
    """One kind of frames that a peer claims to refuse, and when its count changed last."""

    refused: Refused
    changed_at: float


class ProblemClaim(NamedTuple):
    """The codes of a peer's newest problem report, and when it arrived."""

    codes: tuple[int, ...]
    received_at: float


class Claims:
    """What one peer claims in its reports, in bounded memory. Nothing acts on it."""

    __slots__ = ("_refusals", "problems")

    def __init__(self) -> None:
        self._refusals: dict[Kind, Claim] = {}  # the one that changed longest ago first
        self.problems = ProblemClaim((), -c.NEVER)

    def note(self, report: Report, now: float) -> None:
        """Keep a report that is known to be new. A repeated refusal changes nothing."""
        if isinstance(report, ProblemReport):
            self.problems = ProblemClaim(report.codes, now)
            return
        for refused in report.entries:
            kind = refused[:3]
            before = self._refusals.get(kind)
            if before is not None and before.refused == refused:
                continue
            self._refusals.pop(kind, None)
            self._refusals[kind] = Claim(refused, now)
            if len(self._refusals) > c.REFUSALS_KEPT:
                del self._refusals[next(iter(self._refusals))]

    def refusals(self) -> list[Claim]:
        """The kinds that it reported last, the one that changed last first."""
        return list(reversed(self._refusals.values()))
