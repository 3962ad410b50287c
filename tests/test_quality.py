"""Every rule that pyproject.toml configures is run here, and the rule to write plain English."""

from __future__ import annotations

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
