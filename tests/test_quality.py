"""Every rule that pyproject.toml configures is run here, and the rule to write plain English."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ops.schema import golden, log_names, metric_names
from uavlinkd.ops import LOG_SCHEMA, METRICS_SCHEMA

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


WORDS = (
    r"whoever|nobody|anybody|somebody|(?:un)?heard|lately|anew|for ever|in doubt|goodbyes?|amounts?|chances?",
    r"programs?|callers?|troubles?|disturbances?|left behind|told",
    r"hence|thus|thereby|thereof|wherein|whence|thence|(?:for|from|to|by|of|with|against|as|than|but|and|or) who",
)
"""Words that do not help readers from many countries under stress: write the field's own noun, and its subject."""
_WORD = re.compile(rf"(?i)(?<![a-z])(?:{'|'.join(WORDS).replace(' ', '[ _#*]*[ _]')})(?![a-z])")
_MAY_BE_WRITTEN = ("--reuid=nobody", "program_found")
"""An account of every Linux, and an event in the records of a run."""
_TEXTS = ("*.md", "*.toml", ".ci/*", "configs/**/*", "systemd/**/*", "tests/**/*", "uavlinkd/**/*")
_SUFFIXES = frozenset({".py", ".md", ".toml", ".service", ".yml", ".yaml", ".pv", ".pvl", ".c", ".sh", ".txt", ""})


def unclear_words(text: str) -> list[tuple[int, str]]:
    """Each use of a word of the table, with its line."""
    for allowed in _MAY_BE_WRITTEN:
        text = text.replace(allowed, "")
    return [(number, match[0]) for number, line in enumerate(text.splitlines(), 1) for match in _WORD.finditer(line)]


def test_english_is_plain() -> None:
    """No text of the project uses a word of the table; the message gives file, line and word."""
    assert unclear_words("Who\nwas_told: nobody") == [(2, "told"), (2, "nobody")]
    files = {path for pattern in _TEXTS for path in ROOT.glob(pattern) if path.suffix in _SUFFIXES and path.is_file()}
    assert {ROOT / name for name in ("README.md", ".ci/run", "tests/test_cli.py", "uavlinkd/cli.py")} <= files
    uses = [
        f"{path.relative_to(ROOT)}:{line}: {word}"
        for path in sorted(files - {Path(__file__)})
        if "corpus" not in path.parts
        for line, word in unclear_words(path.read_text(errors="replace"))
    ]
    assert not uses, "\n".join(["write other words, see WORDS in this file:", *uses])
