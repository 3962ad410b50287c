"""Whether a measured time depends on something: a permutation test on ranks."""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import accumulate, pairwise

PERMUTATIONS = 2000


def p_value(samples: Sequence[Sequence[float]], permutations: int = PERMUTATIONS) -> float:
    """How often chance alone would set samples as far apart as these are, or further.

    The statistic is Kruskal and Wallis's: by ranks, so that a few very long times decide nothing. Its distribution is
    found by shuffling, so that small samples are judged rightly. The same samples always give the same value.
    """
    ends = list(accumulate((len(sample) for sample in samples), initial=0))
    ranks = _ranks([value for sample in samples for value in sample])
    seen = _between(ranks, ends)
    chance = random.Random(0)  # noqa: S311  of a test, not of a key
    as_far = 0
    for _ in range(permutations):
        chance.shuffle(ranks)
        as_far += _between(ranks, ends) >= seen - 1e-9
    return (as_far + 1) / (permutations + 1)


def _ranks(values: Sequence[float]) -> list[float]:
    """From 1; equal values share the mean of theirs."""
    ordered = sorted(values)
    first: dict[float, int] = {}
    count: dict[float, int] = {}
    for place, value in enumerate(ordered, 1):
        first.setdefault(value, place)
        count[value] = count.get(value, 0) + 1
    return [first[value] + (count[value] - 1) / 2 for value in values]


def _between(ranks: Sequence[float], ends: Sequence[int]) -> float:
    return sum(sum(ranks[start:end]) ** 2 / (end - start) for start, end in pairwise(ends) if end > start)
