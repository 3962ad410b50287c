"""The entry points accept any bytes: a short run of every target by three generators, and the kept corpus."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz import corpus
from tests.fuzz.command import fuzz, main
from tests.fuzz.engine import TALLY, Script, hunt
from tests.fuzz.files import SECRET
from tests.fuzz.registry import TARGETS
from tests.fuzz.worker import replay
from tests.needs import need

names = pytest.mark.parametrize("name", TARGETS)
SHORT_S = 0.3
MAX_CORPUS_BYTES = 400_000


@names
def test_kept_corpus_escapes_nowhere(name: str) -> None:
    """The kept inputs run, and meet the assertions of their targets."""
    kept = corpus.load(name)
    assert kept, "a target without a corpus"
    assert replay(name) > len(kept)


@names
def test_short_hunt_finds_no_escape(name: str) -> None:
    """Variations of the corpus, and new scripts, by a seeded generator."""
    TALLY.clear()
    result = hunt(TARGETS[name], seeds=corpus.load(name)[-8:], seed=2, seconds=SHORT_S)
    assert result.escape is None, f"{result.script!r}: {result.escape!r}"
    assert TALLY.offered >= result.executions > 0
    assert TALLY.distinct <= TALLY.offered


@names
def test_any_bytes_are_a_script(name: str) -> None:
    """The same by Hypothesis, whose inputs are small and unusual."""
    target = TARGETS[name]
    run = target.make()

    @settings(
        max_examples=15, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck)
    )
    @given(st.binary(max_size=200))
    def property_of(data: bytes) -> None:
        run(data)

    property_of()


def test_corpus_is_small_and_belongs_to_targets() -> None:
    """The repository's corpus is bounded, and every file of it belongs to a target."""
    files = list(corpus.KEPT.iterdir())
    assert {path.name for path in files} == {f"{name}.txt" for name in TARGETS}
    assert sum(path.stat().st_size for path in files) < MAX_CORPUS_BYTES


def test_corpus_is_read_as_it_was_written(tmp_path: Path) -> None:
    """Smallest first, without duplicates, and no more than fit."""
    inputs = [b"longer", b"\0", b"\xff\xfe", b"longer", b"", bytes(corpus.MAX_FILE_BYTES)]
    assert corpus.save("any", inputs, tmp_path) == 3
    assert corpus.load("any", tmp_path) == [b"\0", b"\xff\xfe", b"longer"]


def test_corpus_keeps_inputs_with_new_coverage() -> None:
    """An input that reaches no new code is left out; a larger one that does is kept."""
    run = TARGETS["key"].make()
    empty, longer, good = b"x", b"xx", f"{SECRET}\n".encode()
    assert corpus.minimised(run, [good, longer, empty]) == [empty, good]


def test_script_is_total() -> None:
    """Behind its end a script reads zeros, and it ends."""
    script = Script(b"\1\2\3")
    assert (script.byte(), script.word(), script.long(), script.take(9)) == (1, 0x0203, 0, b"")
    assert not script


def test_same_seed_is_the_same_hunt() -> None:
    """The same seed leads to the same result."""
    offered = []
    for _ in range(2):
        TALLY.clear()
        assert hunt(TARGETS["tlog"], seed=9, runs=200).escape is None
        offered.append((TALLY.offered, TALLY.distinct))
    assert offered[0] == offered[1]


@pytest.mark.long
def test_libfuzzer_finds_a_planted_bug(tmp_path: Path) -> None:
    """atheris runs a target in its own process, guided by coverage; an escape is kept, and can be reproduced."""
    need(find_spec("atheris") is not None, "atheris: pip install '.[fuzz]'")
    result = fuzz(TARGETS["key"], runs=5000, escapes=tmp_path, plant="two spellings of a key")
    assert result.escape is not None, result.log
    assert "a key with two spellings" in result.log
    assert main(["key", "--replay", str(result.escape)]) == 0  # without the plant the input passes


def test_command_reports_its_runs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """One line per target with its numbers, and exit code 0 without an escape."""
    assert main(["--list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(TARGETS)
    assert main(["tlog", "--runs", "300", "--engine", "seeded", "--escapes", str(tmp_path)]) == 0
    _, line, total = capsys.readouterr().out.splitlines()
    assert line.split()[:3] == ["tlog", "300", "300"]
    assert total.startswith("300 inputs in ")


def test_command_fails_after_an_escape(tmp_path: Path) -> None:
    """The input is kept."""
    result = fuzz(TARGETS["tlog"], engine="seeded", seed=1, runs=2000, escapes=tmp_path, plant="tlog")
    assert result.escape is not None, result.log
    assert result.escape.read_bytes()
    assert result.executions <= 2000
