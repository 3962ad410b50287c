"""Which tests run: a missing tool skips a test, in CI it fails the test; long tests run in CI only."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import MAY_BE_MISSING

ROOT = Path(__file__).parents[1]


def outcome(folder: Path, *reasons: str, **environ: str) -> str:
    """The summary of pytest for two tests skipped for each reason: one in its body, one in its fixture."""
    file = folder / "test_it.py"
    file.write_text(
        f"import pytest\nreasons = {reasons}\n"
        "@pytest.fixture(params=reasons)\ndef tool(request): pytest.skip(request.param)\n"
        "def test_by_fixture(tool): pass\n"
        "@pytest.mark.parametrize('reason', reasons)\ndef test_in_body(reason): pytest.skip(reason)\n"
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


def test_missing_tool_skips_the_test(tmp_path: Path) -> None:
    """Outside of CI."""
    assert outcome(tmp_path, "needs a tool").startswith("2 skipped")


def test_missing_tool_fails_the_test_in_ci(tmp_path: Path) -> None:
    """In the body of the test and in its fixture."""
    assert outcome(tmp_path, "needs a tool", CI="true").startswith("1 failed, 1 error")


def test_some_tools_may_be_missing_in_ci(tmp_path: Path) -> None:
    """tests/README.md lists them."""
    reasons = [f"{reason}: not here" for reason in MAY_BE_MISSING]
    assert outcome(tmp_path, *reasons, CI="true").startswith(f"{2 * len(reasons)} skipped")


def test_ci_runs_long_tests_without_retries() -> None:
    """Each pytest command in .ci/run selects all tests. A retry would hide a defect of a test."""
    commands = [line for line in (ROOT / ".ci/run").read_text().splitlines() if ".venv/bin/pytest" in line]
    assert len(commands) == 2
    assert all(" -m ''" in command for command in commands)
    assert not any("--last-failed" in command for command in commands)


@pytest.mark.parametrize(("selection", "count"), [((), 1), (("-m", ""), 2)])
def test_long_tests_run_only_when_selected(tmp_path: Path, selection: tuple[str, ...], count: int) -> None:
    """With the settings of this checkout."""
    file = tmp_path / "test_it.py"
    file.write_text("import pytest\n@pytest.mark.long\ndef test_long(): pass\ndef test_short(): pass\n")
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-c", str(ROOT / "pyproject.toml"), *selection]
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", str(file)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip().splitlines()[-1].startswith(f"{count} passed")
