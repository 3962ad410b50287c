"""A permutation test on ranks: does a measured time depend on a parameter?"""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import accumulate, pairwise

PERMUTATIONS = 2000


def p_value(samples: Sequence[Sequence[float]], permutations: int = PERMUTATIONS) -> float:
    """The probability that random samples differ as much as these, or more.

    The statistic is that of Kruskal and Wallis. It uses ranks, so that a few very long times have no large effect.
    Its distribution is computed by shuffling, which is exact for small samples. Equal samples return equal values.
    """
    ends = list(accumulate((len(sample) for sample in samples), initial=0))
    ranks = _ranks([value for sample in samples for value in sample])
    seen = _between(ranks, ends)
    rng = random.Random(0)  # noqa: S311  not a key
    as_far = 0
    for _ in range(permutations):
        rng.shuffle(ranks)
        as_far += _between(ranks, ends) >= seen - 1e-9
    return (as_far + 1) / (permutations + 1)


def _ranks(values: Sequence[float]) -> list[float]:
    """The ranks from 1; equal values share the mean of their ranks."""
    ordered = sorted(values)
    first: dict[float, int] = {}
    count: dict[float, int] = {}
    for place, value in enumerate(ordered, 1):
        first.setdefault(value, place)
        count[value] = count.get(value, 0) + 1
    return [first[value] + (count[value] - 1) / 2 for value in values]


def _between(ranks: Sequence[float], ends: Sequence[int]) -> float:
    return sum(sum(ranks[start:end]) ** 2 / (end - start) for start, end in pairwise(ends) if end > start)
