"""A short hunt finds every planted bug, and nothing once it is taken out."""

from __future__ import annotations

import pytest

from tests.fuzz.engine import hunt
from tests.fuzz.plants import PLANTS
from tests.fuzz.registry import TARGETS

RUNS = 4000
PATIENCE_S = 60.0
"""For a machine that is busy: each is found in a second or two."""


@pytest.mark.parametrize("name", PLANTS)
def test_planted_bug_is_found(name: str) -> None:
    """The same scripts find it where it is, and pass where it is not."""
    plant = PLANTS[name]
    target = TARGETS[plant.target]
    take_out = plant.put()
    try:
        found = hunt(target, seed=1, runs=RUNS, seconds=PATIENCE_S)
    finally:
        take_out()
    assert found.escape is not None, f"{plant.about}: not found in {found.executions} scripts"

    sound = hunt(target, seed=1, runs=found.executions)
    assert sound.escape is None, f"{sound.script!r}: {sound.escape!r}"


def test_every_target_has_a_plant() -> None:
    """No target is without a bug that it was seen to find."""
    assert {plant.target for plant in PLANTS.values()} == set(TARGETS)
