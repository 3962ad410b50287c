"""A path that carries probes and copies and loses the stream is the best path ever more rarely."""

from __future__ import annotations

from collections import Counter

import pytest

from uavlinkd.core import constants as c
from uavlinkd.core.path import Path
from uavlinkd.core.path_state import PathState
from uavlinkd.core.paths import BestChanged, PathSet
from uavlinkd.core.settings import Redundancy
from uavlinkd.core.socket_facts import SocketFacts

FAST, SLOW = Path(0, ("192.0.2.1", 5790)), Path(1, ("192.0.2.2", 5790))
STEP_S = 0.25
LOST = 0.5
"""The share of the stream that the fast path loses."""


class Course:
    """Two usable paths whose questions are answered. The fast one loses datagrams while it is the best."""

    def __init__(self) -> None:
        self.paths = PathSet(Redundancy.CRITICAL, c.PROBE_IDLE_S, Counter(), SocketFacts())
        self.paths.configure((FAST, SLOW), 0.0)
        self.now = 0.0
        self.loses = True
        self.changes: list[tuple[float, Path, str]] = []
        self._received = {FAST: 0, SLOW: 0}
        self.paths.prefer(FAST, 0.0)

    def state(self, path: Path) -> PathState:
        """The slot of a path."""
        state = self.paths.find(path)
        assert state is not None
        return state

    def run(self, until: float) -> None:
        """Each path carries forty datagrams a second, and a question."""
        while self.now < until:
            self.now += STEP_S
            for path, round_trip_s in ((FAST, 0.05), (SLOW, 0.1)):
                state = self.state(path)
                loses = self.loses and path == FAST and state is self.paths.best
                state.sent += 10
                self._received[path] += round(10 * (1 - LOST)) if loses else 10
                self.state(path).make_probe(round(self.now * 100), 0, self.now - round_trip_s)
                is_first = not state.is_validated
                assert state.receive_answer(round(self.now * 100), self._received[path] + 1, self.now) is not None
                self.paths.note_answer(state, self.now, is_first=is_first)
            for change in self.paths.update(self.now):
                if isinstance(change, BestChanged):
                    self.changes.append((self.now, change.state.path, change.reason))

    def returns(self) -> list[float]:
        """How long the fast path was a standby, each time."""
        left = [at for at, path, _ in self.changes if path == SLOW]
        back = [at for at, path, _ in self.changes if path == FAST]
        return [later - earlier for earlier, later in zip(left, back, strict=False)]


def test_a_path_that_loses_only_the_stream_comes_back_ever_later() -> None:
    """Its loss is forgotten within seconds; then it waits for 4 s, 8 s and so on, at most for 64 s."""
    course = Course()
    course.run(400.0)
    assert {reason for _, path, reason in course.changes if path == SLOW} == {"loss"}
    waits = course.returns()
    assert waits == sorted(waits)
    assert waits[1:5] == pytest.approx([10.0, 18.0, 34.0, 66.0], abs=2 * STEP_S)
    assert len(course.changes) < 18  # every nine seconds without it


def test_a_path_that_was_the_best_for_long_does_not_wait() -> None:
    """One bad time of a radio does not count indefinitely."""
    course = Course()
    course.run(60.0)
    course.loses = False
    course.run(60.0 + 4 * c.HELD_BACK_MOST_S)
    assert course.paths.best is course.state(FAST)
    assert course.state(FAST).held_back_s > 0.0
    course.loses = True
    course.run(course.now + 10.0)
    assert course.state(FAST).held_back_s == 0.0
