"""The problems of a link that are worth a line: thresholds over a minute."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import pytest

from uavlinkd.link.event_log import LinkWatch, is_noteworthy
from uavlinkd.ops.link_problems import LinkProblem

MISSING, ECHOES = LinkProblem.ENVELOPES_MISSING, LinkProblem.ECHOES_UNANSWERED


def noted(problem: LinkProblem, total: Callable[[int], int], received: int = 20, seconds: int = 600) -> list[int]:
    """The seconds in which a link with this total of one problem has it; ``received`` envelopes a second arrive."""
    watch, is_open, noted_at = LinkWatch(), False, []
    for second in range(seconds):
        (growth,) = watch.measure({problem: total(second)}, received * (second + 1), float(second)).values()
        is_open = is_noteworthy(problem, growth, is_logged=is_open)
        noted_at += [second] if is_open else []
    return noted_at


@pytest.mark.parametrize("rate", [1, 20, 1000])
def test_loss_of_a_hundredth_is_not_noted(rate: int) -> None:
    """A day of random loss of 1 %, at any rate of frames."""
    rng, totals, missing = Random(rate), [], 0
    for _ in range(86400):
        missing += sum(rng.random() < 0.01 for _ in range(rate)) if rate < 100 else round(rng.gauss(0.01 * rate, 3.0))
        totals.append(missing)
    assert noted(MISSING, totals.__getitem__, rate, 86400) == []


def test_loss_of_a_tenth_is_noted_and_ends() -> None:
    """Within a minute of its beginning, and until it is below half of the threshold."""
    noted_at = noted(MISSING, lambda second: 2 * min(max(0, second - 100), 100))
    assert 100 < noted_at[0] < 145
    assert 230 < noted_at[-1] < 270
    assert noted_at == list(range(noted_at[0], noted_at[-1] + 1))


def test_counts_without_a_share_have_a_threshold_of_their_own() -> None:
    """Unanswered echo requests: a lossy link causes some."""
    assert noted(ECHOES, lambda second: second // 10) == []
    assert noted(ECHOES, lambda second: second // 2)
    assert noted(LinkProblem.PATHS_UNPROVEN, lambda second: int(second >= 50))[0] == 50


def test_reset_counters_are_a_new_baseline() -> None:
    """After a key change the counters start at zero: their increase counts."""
    watch = LinkWatch()
    for second, (total, received) in enumerate([(9, 100), (2, 10), (5, 20)]):
        growth = watch.measure({MISSING: total}, received, float(second))[MISSING]
    assert growth.since == 3
    assert watch.totals == {MISSING: 12}
