"""The entry points accept any bytes: a short run of every target by three generators, the kept corpus, plants."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.fuzz import corpus
from tests.fuzz.__main__ import fuzz, main
from tests.fuzz.engine import hunt
from tests.fuzz.plants import PLANTS, put
from tests.fuzz.registry import TARGETS
from tests.needs import need
from tests.waiting import PATIENCE_S

SHORT_S = 0.1
SLOW = ("candidates", "relay")
"""Targets whose kept corpus takes seconds."""
MAX_CORPUS_BYTES = 400_000
RUNS = 4000


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name in SLOW else ()) for name in TARGETS]
)
def test_short_hunt_finds_no_escape(name: str) -> None:
    """The kept corpus, variations of it, and new scripts, by a seeded generator."""
    target, kept = TARGETS[name], corpus.load(name)
    assert kept, "a target without a corpus"
    for result in (
        hunt(target, kept=kept, runs=len(kept) + 5),
        hunt(target, kept=kept[-8:], seed=2, seconds=SHORT_S),
    ):
        assert result.escape is None, f"{result.script!r}: {result.escape!r}"
        assert result.executions > 0


@pytest.mark.long
@pytest.mark.parametrize("about", PLANTS)
def test_planted_fault_is_found(about: str) -> None:
    """The same scripts fail with the fault, and pass without it."""
    target = TARGETS[PLANTS[about].target]
    kept = corpus.load(target.name)
    take_out = put(about)
    try:
        result = hunt(target, kept=kept, seed=1, runs=RUNS, seconds=PATIENCE_S)
    finally:
        take_out()
    assert result.escape is not None, f"{about}: not found in {result.executions} scripts"
    sound = hunt(target, kept=kept, seed=1, runs=result.executions)
    assert sound.escape is None, f"{sound.script!r}: {sound.escape!r}"


def test_corpus_and_plants_belong_to_targets() -> None:
    """Every target has a fault that it finds, and a corpus, which is small."""
    assert {plant.target for plant in PLANTS.values()} == set(TARGETS)
    kept = list(corpus.KEPT.iterdir())
    assert {path.name for path in kept} == {f"{name}.txt" for name in TARGETS}
    assert sum(path.stat().st_size for path in kept) < MAX_CORPUS_BYTES


@pytest.mark.long
def test_libfuzzer_finds_a_planted_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """atheris runs a target in its own process, guided by coverage; an escape is kept, and can be reproduced."""
    need(find_spec("atheris") is not None, "atheris: pip install '.[fuzz]'")
    monkeypatch.chdir(tmp_path)
    assert "a key with two spellings" in fuzz("key", ["-runs=5000", "-seed=1"], plant="two spellings of a key")
    (escape,) = tmp_path.glob("escape-key-crash-*")
    assert main(["key", "--replay", str(escape)]) == 0  # without the plant the input passes
    assert main(["key", "-runs=100"]) == 0
