"""Every rule that pyproject.toml configures is run here, and the rule to write plain English."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path, PurePosixPath

import pytest

from tests import plain_english
from tests.ops.schema import golden, log_names, metric_names
from uavlinkd.ops.schema_versions import LOG_SCHEMA, METRICS_SCHEMA

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "tool",
    [
        pytest.param(("ruff", "check", "."), id="ruff check"),
        pytest.param(("ruff", "format", "--check", "."), id="ruff format"),
        pytest.param(("mypy", "--no-incremental"), id="mypy", marks=pytest.mark.long),
    ],
)
def test_tree_is_clean(tool: tuple[str, ...]) -> None:
    """Lint, format and strict types hold for the package and its tests."""
    result = subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("kind", ["log", "metrics"])
def test_names_are_declared(kind: str) -> None:
    """Log events, their fields and the metrics are those in `tests/ops/schema`; the message says what to do."""
    declared = golden.load(kind)
    if kind == "log":
        problems = golden.differences(kind, LOG_SCHEMA, declared, log_names.observed(declared["names"]))
    else:
        problems = golden.differences(kind, METRICS_SCHEMA, declared, metric_names.observed())
    assert not problems, "\n".join(problems)


def test_english_is_plain() -> None:
    """No text uses a word of the table, but for the exceptions; the message gives file, line and word."""
    uses = list(map(str, plain_english.all_uses()))

    assert not uses, "\n".join(["write other words, see tests/plain_english.py:", *uses])


def test_use_is_reported_with_its_file_and_line() -> None:
    """As editors and terminals link it."""
    uses = plain_english.uses("Nobody is\ntold.", PurePosixPath("folder/planted.md"))

    assert list(map(str, uses)) == ["folder/planted.md:1: Nobody", "folder/planted.md:2: told"]


@pytest.mark.parametrize(
    ("planted", "words"),
    [
        ("# The drop is told\n# for ever, or is left\n# behind.", ["told", "for ever", "left # behind"]),
        ('"""Whoever was heard lately: a goodbye."""', ["Whoever", "heard", "lately", "goodbye"]),
        ('log.info("troubles", unheard=1)', ["troubles", "unheard"]),
        ("def test_the_caller_is_no_client() -> None: ...", ["caller", "is_no_client"]),
        ("def deliver(amount: int, each: bytes) -> None: ...", ["amount", "each"]),
        ("for each in found:\n    found = [each for each in each]", ["each", "found", "each"]),
        ("amounts = rng.chance", ["amounts", "chance"]),
    ],
)
def test_words_are_found(planted: str, words: list[str]) -> None:
    """In comments across lines, docstrings, strings and names; `each` and `found` only as names."""
    uses = plain_english.uses(planted, PurePosixPath("uavlinkd/planted.py"))

    assert [use.word for use in uses] == words


@pytest.mark.parametrize(
    "plain",
    [
        "The daemon received each frame, and found none of them. There is no frame. It is no longer open.",
        "assert frame is None",
        "untold, retold. Who may send it?",
    ],
)
def test_plain_english_passes(plain: str) -> None:
    """Other words that contain one of the table, and ordinary uses of `each`, `found` and `none`."""
    assert not plain_english.uses(plain, PurePosixPath("plain.md"))


def test_every_text_is_read() -> None:
    """Code, tests, documents, configurations, units and models."""
    files = set(map(str, plain_english.files()))

    assert {
        *("README.md", "pyproject.toml", ".ci/run", "configs/drone0.toml", "systemd/uavlinkd.service"),
        *("tests/test_cli.py", "tests/formal/uavlink.pvl", "uavlinkd/cli.py", "uavlinkd/core/README.md"),
    } <= files


@pytest.mark.parametrize("allowed", plain_english.ALLOWED, ids=lambda allowed: allowed.text)
def test_exceptions_are_needed(allowed: plain_english.Allowed) -> None:
    """Each text that may be written is written somewhere, contains a word of the table, and has a reason."""
    texts = [(ROOT / file).read_text() for file in plain_english.files() if file.match(allowed.files)]

    assert any(allowed.text in text for text in texts)
    assert plain_english.uses(allowed.text, PurePosixPath("text.txt"), exceptions=())
    assert allowed.reason
