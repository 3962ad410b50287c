"""A short hunt finds every planted fault, and nothing once it is removed."""

from __future__ import annotations

import pytest

from tests.fuzz.engine import hunt
from tests.fuzz.plants import PLANTS
from tests.fuzz.registry import TARGETS
from tests.waiting import PATIENCE_S

RUNS = 4000

SLOWEST = "unbounded sessions"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name == SLOWEST else ()) for name in PLANTS]
)
def test_planted_bug_is_found(name: str) -> None:
    """The same scripts fail with the fault, and pass without it."""
    plant = PLANTS[name]
    target = TARGETS[plant.target]
    take_out = plant.put()
    try:
        result = hunt(target, seed=1, runs=RUNS, seconds=PATIENCE_S)
    finally:
        take_out()
    assert result.escape is not None, f"{plant.about}: not found in {result.executions} scripts"

    sound = hunt(target, seed=1, runs=result.executions)
    assert sound.escape is None, f"{sound.script!r}: {sound.escape!r}"


def test_every_target_has_a_plant() -> None:
    """Each target has a fault that it finds."""
    assert {plant.target for plant in PLANTS.values()} == set(TARGETS)
