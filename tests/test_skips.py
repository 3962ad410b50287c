"""Which tests run: a missing tool skips a test, in CI it fails the test; long tests run in CI only."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.needs import MAY_BE_MISSING

ROOT = Path(__file__).parents[1]


def environment(**added: str) -> dict[str, str]:
    """That of this process, without what would change another run of pytest."""
    return {name: value for name, value in os.environ.items() if name not in {"CI", "PYTEST_ADDOPTS"}} | added


def run_pytest(*arguments: str, **environ: str) -> str:
    """The output of another run."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    environ = environment(**environ)
    return subprocess.run(command, cwd=ROOT, env=environ, capture_output=True, text=True, check=False).stdout


def outcome(folder: Path, *reasons: str, whole: bool = False, **environ: str) -> str:
    """The last line of pytest, or all, for two tests skipped for each reason: one in its body, one in its fixture."""
    file = folder / "test_it.py"
    file.write_text(
        f"import pytest\nreasons = {reasons}\n"
        "@pytest.fixture(params=reasons)\ndef tool(request): pytest.skip(request.param)\n"
        "def test_by_fixture(tool): pass\n"
        "@pytest.mark.parametrize('reason', reasons)\ndef test_in_body(reason): pytest.skip(reason)\n"
    )
    shown = run_pytest("-rs", "-p", "tests.conftest", str(file), **environ)
    return shown if whole else shown.strip().splitlines()[-1]


@pytest.mark.long
def test_missing_tool_fails_the_test_in_ci_only(tmp_path: Path) -> None:
    """In the body of the test and in its fixture. Some tools may be missing in CI too: tests/README.md lists them."""
    assert outcome(tmp_path, "needs a tool").startswith("2 skipped")
    assert outcome(tmp_path, "needs a tool", CI="true").startswith("1 failed, 1 error")
    reasons = [f"{reason}: not here" for reason in MAY_BE_MISSING]
    assert outcome(tmp_path, *reasons, CI="true").startswith(f"{2 * len(reasons)} skipped")


def test_ci_runs_all_tests_without_retries() -> None:
    """The README's commands as they stand, then all that the second one leaves out. A retry would hide a defect."""
    text = (ROOT / ".ci/run").read_text()
    (read,) = (line for line in text.splitlines() if line.startswith("mapfile"))
    script = f'{read}; printf "%s\\n" "${{commands[@]}}"'
    readme = subprocess.run(["bash", "-c", script], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert re.fullmatch(r"python3 -m venv .*uavlinkd demo\npython3 -m venv .*pytest -q\n", readme)
    assert all(
        f"\n\n```sh\n{command}\n```\n\n" in (ROOT / "README.md").read_text() for command in readme.splitlines()
    )
    commands = [line.partition(".venv/bin/pytest ")[2] for line in text.splitlines() if ".venv/bin/pytest" in line]
    assert commands == [
        "-q -m '(long or sitl or recorded) and not alone' || status=1",
        "-q -m '(long or sitl or recorded) and alone' -n 0 || status=1",
        "-q -m '' tests/protocol --cov=uavlinkd/protocol --cov-branch --cov-fail-under=100 || status=1",
    ]
    assert text.rstrip().endswith('exit "$status"')


@pytest.mark.parametrize(("selection", "count"), [((), 1), (("-m", ""), 2)])
@pytest.mark.long
def test_long_tests_run_only_when_selected(tmp_path: Path, selection: tuple[str, ...], count: int) -> None:
    """With the settings of this checkout."""
    file = tmp_path / "test_it.py"
    file.write_text("import pytest\n@pytest.mark.long\ndef test_long(): pass\ndef test_short(): pass\n")
    shown = run_pytest("-n", "0", "-c", str(ROOT / "pyproject.toml"), *selection, str(file))
    assert shown.strip().splitlines()[-1].startswith(f"{count} passed")
