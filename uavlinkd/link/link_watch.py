"""When the problems of a link are worth a line: what was lost, reordered or unanswered over the last minute."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from typing import Final, NamedTuple

from uavlinkd.ops.link_problems import LinkProblem

WINDOW_S: Final = 60.0
STEP_S: Final = 5.0
"""The window moves in steps of this."""


class Threshold(NamedTuple):
    """A problem is logged from this count in a minute, if it is also this share of the envelopes.

    A problem that was logged has ended below half of both.
    """

    least: int
    share: float = 0.0


THRESHOLDS: Final[Mapping[LinkProblem, Threshold]] = {
    LinkProblem.ENVELOPES_MISSING: Threshold(10, 0.05),
    LinkProblem.ENVELOPES_OUT_OF_ORDER: Threshold(50, 0.25),  # jitter reorders frames that were sent in a burst
    LinkProblem.PATHS_UNPROVEN: Threshold(1),  # no bad radio causes it: an attacker forwards envelopes
    LinkProblem.ECHOES_UNANSWERED: Threshold(20),
    LinkProblem.HANDSHAKES_UNANSWERED: Threshold(10),
    LinkProblem.COOKIES_TAKEN: Threshold(5),
}


class Growth(NamedTuple):
    """How often a problem occurred."""

    minute: int
    """In the last minute."""
    since: int
    """Since the last measurement."""
    share: float
    """Of the envelopes of the last minute."""


class LinkWatch:
    """The totals of one link over the last minute."""

    def __init__(self) -> None:
        self.totals: Counter[LinkProblem] = Counter()
        """All problems since the start."""
        self._before: dict[LinkProblem, int] = {}
        self._received = self._received_before = 0
        self._steps: deque[tuple[float, Counter[LinkProblem], int]] = deque()

    def measure(self, totals: Mapping[LinkProblem, int], received: int, now: float) -> dict[LinkProblem, Growth]:
        """Compare with the totals of a minute ago. Call it about once a second.

        A smaller total means that the counter was reset. It is the new baseline.
        """
        grown = {problem: max(0, total - self._before.get(problem, 0)) for problem, total in totals.items()}
        self.totals.update(grown)
        self._before = dict(totals)
        if not self._steps or now - self._steps[-1][0] >= STEP_S:
            self._steps.append((now, self.totals - Counter(grown), self._received))
        self._received += max(0, received - self._received_before)
        self._received_before = received
        while len(self._steps) > 1 and self._steps[1][0] <= now - WINDOW_S:
            self._steps.popleft()
        _, then, received_then = self._steps[0]
        arrived = self._received - received_then
        missing = self.totals[LinkProblem.ENVELOPES_MISSING] - then[LinkProblem.ENVELOPES_MISSING]
        sent = max(1, arrived + missing)
        return {
            problem: Growth(minute := self.totals[problem] - then[problem], since, minute / sent)
            for problem, since in grown.items()
        }


def is_noteworthy(problem: LinkProblem, growth: Growth, *, is_logged: bool) -> bool:
    """Whether the problem exceeds its threshold, or still exceeds half of it."""
    threshold, scale = THRESHOLDS[problem], 0.5 if is_logged else 1.0
    return growth.minute >= threshold.least * scale and growth.share >= threshold.share * scale
