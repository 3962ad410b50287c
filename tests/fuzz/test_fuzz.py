"""The entry points take any bytes: a short run of every target, by three generators, and the kept corpus."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.daemon.harness import need
from tests.fuzz import corpus
from tests.fuzz.command import fuzz, main
from tests.fuzz.engine import TALLY, Script, hunt
from tests.fuzz.files import SECRET
from tests.fuzz.registry import TARGETS
from tests.fuzz.worker import replay

names = pytest.mark.parametrize("name", TARGETS)
SHORT_S = 0.3
MAX_CORPUS_BYTES = 400_000


@names
def test_kept_corpus_escapes_nowhere(name: str) -> None:
    """What fuzzing found worth keeping runs, and none of it breaks what its target asserts."""
    kept = corpus.load(name)
    assert kept, "a target without a corpus"
    assert replay(name) > len(kept)


@names
def test_short_hunt_finds_no_escape(name: str) -> None:
    """Variations of the corpus, and scripts made anew, by a seeded generator."""
    TALLY.clear()
    result = hunt(TARGETS[name], seeds=corpus.load(name)[-8:], seed=2, seconds=SHORT_S)
    assert result.escape is None, f"{result.script!r}: {result.escape!r}"
    assert TALLY.offered >= result.executions > 0
    assert TALLY.distinct <= TALLY.offered


@names
def test_any_bytes_are_a_script(name: str) -> None:
    """The same by Hypothesis, whose bytes are small and strange."""
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
    """The repository keeps no more than is worth its bytes, and nothing that no target runs."""
    files = list(corpus.KEPT.iterdir())
    assert {path.name for path in files} == {f"{name}.txt" for name in TARGETS}
    assert sum(path.stat().st_size for path in files) < MAX_CORPUS_BYTES


def test_corpus_is_read_as_it_was_written(tmp_path: Path) -> None:
    """Smallest first, none twice, and no more than fits."""
    inputs = [b"longer", b"\0", b"\xff\xfe", b"longer", b"", bytes(corpus.MAX_FILE_BYTES)]
    assert corpus.save("any", inputs, tmp_path) == 3
    assert corpus.load("any", tmp_path) == [b"\0", b"\xff\xfe", b"longer"]


def test_corpus_keeps_what_goes_new_ways() -> None:
    """An input that reaches nothing new is left out, a larger one that does is kept."""
    run = TARGETS["key"].make()
    empty, longer, good = b"x", b"xx", f"{SECRET}\n".encode()
    assert corpus.minimised(run, [good, longer, empty]) == [empty, good]


def test_script_is_total() -> None:
    """Past its end a script reads zeros, and ends."""
    script = Script(b"\1\2\3")
    assert (script.byte(), script.word(), script.long(), script.take(9)) == (1, 0x0203, 0, b"")
    assert not script


def test_same_seed_is_the_same_hunt() -> None:
    """What a seed found once it finds again."""
    offered = []
    for _ in range(2):
        TALLY.clear()
        assert hunt(TARGETS["tlog"], seed=9, runs=200).escape is None
        offered.append((TALLY.offered, TALLY.distinct))
    assert offered[0] == offered[1]


def test_libfuzzer_finds_a_planted_bug(tmp_path: Path) -> None:
    """atheris runs a target in a process of its own, guided by its coverage; what escapes is kept, and reproduces."""
    need(find_spec("atheris") is not None, "atheris: pip install '.[fuzz]'")
    found = fuzz(TARGETS["key"], runs=5000, escapes=tmp_path, plant="two spellings of a key")
    assert found.escape is not None, found.log
    assert "a key with two spellings" in found.log
    assert main(["key", "--replay", str(found.escape)]) == 0  # without the plant it is no escape


def test_command_reports_what_it_ran(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A line a target with its numbers, and exit code 0 where nothing escaped."""
    assert main(["--list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(TARGETS)
    assert main(["tlog", "--runs", "300", "--engine", "seeded", "--escapes", str(tmp_path)]) == 0
    _, line, total = capsys.readouterr().out.splitlines()
    assert line.split()[:3] == ["tlog", "300", "300"]
    assert total.startswith("300 inputs in ")


def test_command_fails_where_something_escapes(tmp_path: Path) -> None:
    """The input is kept."""
    found = fuzz(TARGETS["tlog"], engine="seeded", seed=1, runs=2000, escapes=tmp_path, plant="tlog")
    assert found.escape is not None, found.log
    assert found.escape.read_bytes()
    assert found.executions <= 2000
