"""What is not there is skipped; in CI it has to be there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import MAY_BE_MISSING

ROOT = Path(__file__).parents[1]


def outcome(folder: Path, reason: str, **environ: str) -> str:
    """What pytest makes of a test that is skipped for this reason, in its body and in what it needs."""
    file = folder / "test_it.py"
    file.write_text(
        f"import pytest\n@pytest.fixture\ndef tool():\n    pytest.skip({reason!r})\n"
        f"def test_by_need(tool): pass\ndef test_by_itself(): pytest.skip({reason!r})\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "tests.conftest", "-p", "no:cacheprovider", str(file)],
        cwd=ROOT,
        env={**{name: value for name, value in os.environ.items() if name != "CI"}, **environ},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip().splitlines()[-1]


def test_what_is_missing_is_skipped(tmp_path: Path) -> None:
    """On anybody's machine."""
    assert outcome(tmp_path, "needs a tool").startswith("2 skipped")


def test_in_ci_nothing_is_missing(tmp_path: Path) -> None:
    """A skip is a failure there, wherever it comes from."""
    assert outcome(tmp_path, "needs a tool", CI="true").startswith("1 failed, 1 error")


@pytest.mark.parametrize("reason", MAY_BE_MISSING)
def test_some_things_may_be_missing_there_too(tmp_path: Path, reason: str) -> None:
    """Those that the README names."""
    assert outcome(tmp_path, f"{reason}: not here", CI="true").startswith("2 skipped")


def test_ci_runs_the_long_tests_too() -> None:
    """Each pytest of .ci/run overrides what pyproject.toml leaves out."""
    commands = [line for line in (ROOT / ".ci/run").read_text().splitlines() if ".venv/bin/pytest" in line]
    assert len(commands) == 2
    assert all(" -m '' " in command for command in commands)


@pytest.mark.parametrize(("selection", "count"), [((), 1), (("-m", ""), 2)])
def test_long_tests_are_left_out_unless_asked_for(tmp_path: Path, selection: tuple[str, ...], count: int) -> None:
    """By the settings of this checkout."""
    file = tmp_path / "test_it.py"
    file.write_text("import pytest\n@pytest.mark.long\ndef test_long(): pass\ndef test_short(): pass\n")
    command = [sys.executable, "-m", "pytest", "-q", "-c", str(ROOT / "pyproject.toml"), "-p", "no:cacheprovider"]
    done = subprocess.run([*command, *selection, str(file)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.strip().splitlines()[-1].startswith(f"{count} passed")
