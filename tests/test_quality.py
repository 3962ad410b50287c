"""Every rule that pyproject.toml configures is run here: a rule that nobody runs is none."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "tool",
    [("ruff", "check", "."), ("ruff", "format", "--check", "."), ("mypy", "--no-incremental")],
    ids=" ".join,
)
def test_tree_is_clean(tool: tuple[str, ...]) -> None:
    """Lint, format and strict types hold for the package and its tests."""
    result = subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
