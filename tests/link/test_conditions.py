"""Conditions: their first, further and last lines, and the limits on lines."""

from __future__ import annotations

import pytest

from uavlinkd.link import conditions
from uavlinkd.link.conditions import (
    HOUR_S,
    LINES_BURST,
    LINES_PER_S,
    QUIET_S,
    TOTAL_BURST,
    TOTAL_LINES_PER_S,
    Conditions,
    LineLimits,
    OpenCondition,
    Phase,
)

BEGAN, CONTINUED, ENDED = Phase

Key = tuple[str, str]


class Written:
    """Conditions that record their lines: phase, key, count, duration, omitted lines."""

    def __init__(self, limits: LineLimits | None = None, kind: str = "drop", *, counts_events: bool = False) -> None:
        self.lines: list[tuple[Phase, Key, int, float, int]] = []
        self.conditions = Conditions[Key](
            kind,
            limits or LineLimits(),
            self._write,
            lambda key: (key[1], key[0] == "bad_tag"),
            counts_events=counts_events,
        )

    def _write(self, key: Key, phase: Phase, condition: OpenCondition, omitted: dict[str, int]) -> None:
        line = phase, key, condition.count, condition.duration_s, omitted.get("omitted_before", 0)
        self.lines.append(line)

    def run(self, *keys: Key, begin: float, end: float, step: float = 1.0) -> None:
        """Let conditions occur, and check them, in steps from ``begin`` until before ``end``."""
        now = begin
        while now < end:
            for key in keys:
                self.conditions.note(key, now)
            self.conditions.check(now)
            now += step

    def phases(self) -> list[Phase]:
        """The phase of each line."""
        return [line[0] for line in self.lines]


def test_condition_has_a_line_at_its_beginning_and_at_its_end() -> None:
    """The first line comes at once, the last one after the quiet time, with all counts."""
    written = Written()
    written.run(("malformed", "b"), begin=100, end=130)
    assert written.lines == [(BEGAN, ("malformed", "b"), 1, 0.0, 0)]
    written.run(begin=130, end=129 + QUIET_S)
    assert written.phases() == [BEGAN]
    written.run(begin=129 + QUIET_S, end=400)
    assert written.lines[1:] == [(ENDED, ("malformed", "b"), 30, 29.0, 0)]


def test_lasting_condition_has_fewer_and_fewer_lines() -> None:
    """After an hour, then after twice the time, up to a day: a week of it causes eleven."""
    written = Written()
    written.run(("malformed", "b"), begin=0, end=7 * 24 * HOUR_S, step=50)
    assert written.phases() == [BEGAN] + 10 * [CONTINUED]
    assert [line[3] / HOUR_S for line in written.lines[1:]] == [1, 3, 7, 15, 31, 55, 79, 103, 127, 151]


@pytest.mark.parametrize("interval_s", [70, 120, 300, 1000, 3000])
def test_condition_that_comes_and_goes_settles(interval_s: int) -> None:
    """However often it occurs: the quiet time grows until it is long enough."""
    written = Written()
    for second in range(0, 24 * int(HOUR_S), 10):
        if second % interval_s == 0:
            written.conditions.note(("malformed", "b"), float(second))
        written.conditions.check(float(second))
    written.conditions.close()
    assert len(written.lines) <= 5 + 2 * 7, "the quiet time is doubled six times"
    ended = sum(line[2] for line in written.lines if line[0] is ENDED)
    assert ended == len(range(0, 24 * int(HOUR_S), interval_s)), "the last lines have every count"


def test_attacker_who_changes_its_attack_all_day_causes_a_bounded_number_of_lines() -> None:
    """Thousands of kinds of drops of one peer: its limit holds, and no line is lost without a count."""
    written = Written()
    for number in range(500):
        written.run((f"kind{number}", "b"), begin=200.0 * number, end=200.0 * number + 200, step=20)
    seconds = 500 * 200
    assert LINES_BURST <= len(written.lines) <= LINES_BURST + LINES_PER_S * seconds + 1
    written.conditions.close()
    begun = sum(line[0] is BEGAN for line in written.lines)
    assert begun + sum(line[4] for line in written.lines) >= 495


def test_all_peers_together_are_limited() -> None:
    """A hundred peers that all attack do not exceed the total limit."""
    written = Written()
    for number in range(200):
        for peer in range(100):
            written.conditions.note((f"kind{number}", f"peer{peer}"), 20.0 * number)
        written.conditions.check(20.0 * number)
    assert len(written.lines) <= TOTAL_BURST + TOTAL_LINES_PER_S * 20 * 200 + 1


@pytest.mark.parametrize("everyday_peer", ["b", "thirty others"])
def test_security_line_is_not_pushed_out_by_everyday_ones(everyday_peer: str) -> None:
    """While every other line exceeds its limit, a security condition is logged at once, and so is its end."""
    written = Written()
    names = ["b"] if everyday_peer == "b" else [f"peer{number}" for number in range(30)]
    for number in range(60):
        for name in names:
            written.conditions.note((f"kind{number}", name), 1.0)
    before = len(written.lines)
    written.conditions.note(("malformed", names[0]), 2.0)
    assert len(written.lines) == before, "the limits are used up"
    written.conditions.note(("bad_tag", names[0]), 2.0)
    assert written.lines[-1][:2] == (BEGAN, ("bad_tag", names[0]))
    written.run(begin=3, end=70)
    assert (ENDED, ("bad_tag", names[0])) in [line[:2] for line in written.lines]


def test_first_security_line_needs_no_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if the limit of security lines is used up, each of them has its first line."""
    monkeypatch.setattr(conditions, "LINES_BURST", 0)
    written = Written()
    written.conditions.note(("malformed", "b"), 1.0)
    assert written.lines == []
    written.conditions.note(("bad_tag", "b"), 1.0)
    assert written.phases() == [BEGAN]


def test_last_lines_are_written_when_the_daemon_stops() -> None:
    """They need no limit: one for each open condition. One that was not logged has its first line."""
    written = Written()
    for number in range(LINES_BURST + 2):
        written.conditions.note((f"kind{number}", "b"), 0.0, 7)
    written.lines.clear()
    written.conditions.close()
    assert written.phases() == LINES_BURST * [ENDED] + 2 * [BEGAN]
    assert {line[2] for line in written.lines} == {7}


@pytest.mark.parametrize("reason", ["bad_tag", "malformed"])
def test_flood_is_not_hidden_by_a_condition_that_is_open_already(reason: str) -> None:
    """One in 30 s for eight hours, then 1,000/s for six: a line for each growth by ten, for security."""
    written = Written(counts_events=True)
    key = (reason, "b")
    written.run(key, begin=0, end=8 * HOUR_S, step=30)
    assert written.phases() == [BEGAN] + 3 * [CONTINUED]
    written.lines.clear()
    for second in range(6 * int(HOUR_S)):
        written.conditions.note(key, 8 * HOUR_S + second, 1000)
        written.conditions.check(8 * HOUR_S + second)
        if second == 30 and reason == "bad_tag":
            assert written.phases() == [CONTINUED], "the flood has a line soon"
    assert len(written.lines) <= (6 if reason == "bad_tag" else 0)
