"""The test for whether a time depends on something."""

from __future__ import annotations

import random

import pytest

from uavlinkd.lab.evaluation.dependence import _ranks, p_value


def test_samples_of_one_kind_are_rarely_distinguished() -> None:
    """Of a hundred triples of samples from one distribution, with a long tail, about five are below 5 %."""
    rng = random.Random(4)
    result = sum(
        p_value([[rng.expovariate(1.0) for _ in range(10)] for _ in range(3)], permutations=200) < 0.05
        for _ in range(100)
    )
    assert result <= 12


def test_samples_that_differ_are_distinguished() -> None:
    """Twice as long on the average is enough at thirty measurements each."""
    rng = random.Random(5)
    samples = [[rng.expovariate(1 / mean) for _ in range(30)] for mean in (1.0, 1.0, 3.0)]
    assert p_value(samples) < 0.01


def test_a_few_very_long_times_decide_nothing() -> None:
    """Ranks, not seconds."""
    assert p_value([[1.0, 2.0, 3.0, 4.0], [1.5, 2.5, 3.5, 1e9]]) > 0.1


def test_equal_times_share_their_rank() -> None:
    """Samples of equal times do not differ."""
    assert _ranks([2.0, 1.0, 2.0, 3.0]) == [2.5, 1.0, 2.5, 4.0]
    assert p_value([[1.0] * 5, [1.0] * 5]) == pytest.approx(1.0)
