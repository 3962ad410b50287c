"""Which tests run: a missing tool skips a test, in CI it fails the test; long tests run in CI only."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import MAY_BE_MISSING

ROOT = Path(__file__).parents[1]


def environment(**added: str) -> dict[str, str]:
    """That of this process, without what would change another run of pytest."""
    return {name: value for name, value in os.environ.items() if name not in {"CI", "PYTEST_ADDOPTS"}} | added


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
        env=environment(**environ),
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


def test_ci_runs_all_tests_without_retries() -> None:
    """The two runs of .ci/run select all tests, also long ones. A retry would hide a defect of a test."""
    text = (ROOT / ".ci/run").read_text()
    commands = [line.partition(".venv/bin/pytest ")[2] for line in text.splitlines() if ".venv/bin/pytest" in line]
    assert [command.partition(" ||")[0] for command in commands] == [
        "-q -m 'not alone'",
        "-q -m alone -n 0",
        "-q -m '' tests/core --cov=uavlinkd/core --cov-branch --cov-fail-under=100",
    ]
    assert all(command.endswith(" || status=1") for command in commands)
    assert text.rstrip().endswith('exit "$status"')


def test_folders_that_measure_daemons_run_alone() -> None:
    """By tests/conftest.py, whatever marks the tests have themselves."""
    folders = ["tests/pressure", "tests/system"]
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "--collect-only", "-p", "no:cacheprovider"]
    listed = {
        marks: subprocess.run(
            [*command, "-m", marks, *folders],
            cwd=ROOT,
            env=environment(),
            capture_output=True,
            text=True,
            check=False,
        ).stdout
        for marks in ("alone", "not alone")
    }
    assert "tests/pressure/" in listed["alone"]
    assert "tests/system/" not in listed["alone"]
    assert "tests/pressure/" not in listed["not alone"]
    assert "tests/system/" in listed["not alone"]


@pytest.mark.parametrize(("selection", "count"), [((), 1), (("-m", ""), 2)])
def test_long_tests_run_only_when_selected(tmp_path: Path, selection: tuple[str, ...], count: int) -> None:
    """With the settings of this checkout."""
    file = tmp_path / "test_it.py"
    file.write_text("import pytest\n@pytest.mark.long\ndef test_long(): pass\ndef test_short(): pass\n")
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-c", str(ROOT / "pyproject.toml"), *selection]
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", str(file)],
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip().splitlines()[-1].startswith(f"{count} passed")
