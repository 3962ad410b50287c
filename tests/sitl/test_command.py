"""The command lines of the flights: what cannot be flown is one line and exit status 2, without a simulator."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.sitl import __main__ as command
from tests.sitl.scenarios import Record, Run

EXECUTABLE = "/bin/sh"


@pytest.fixture(autouse=True)
def no_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment names no simulator, and nothing flies."""
    for name in ("UAVLINKD_ARDUPILOT", "UAVLINKD_PX4"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(command, "fly_quietly", passed)


def passed(run: Run, _: Path) -> Record:
    """The record of a run that passed, without its flight."""
    return Record(run.scenario, run.kind, run.condition, run.with_daemons)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The error of a command line."""
    assert command.main(arguments) == command.USAGE
    shown = capsys.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    return line


@pytest.mark.parametrize(
    "selection",
    [
        ("--kind", "own", "--scenario", "signing"),
        ("--kind", "px4", "--scenario", "signing"),
        ("--scenario", "flight", "--condition", "slow-budget"),
    ],
)
def test_empty_selection_is_refused(
    selection: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No tables are written."""
    monkeypatch.setenv("UAVLINKD_PX4", EXECUTABLE)
    assert "no scenario has this selection" in refused(capsys, "--out", str(tmp_path / "out"), *selection)
    assert not (tmp_path / "out").exists()


def test_run_that_passed_before_is_not_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A selection of such runs only is not an error: the tables are written again."""
    arguments = ("--out", str(tmp_path), "--kind", "own", "--scenario", "parameters-mission", "--condition", "loss10")
    assert command.main(arguments) == command.OK
    assert len(capsys.readouterr().out.splitlines()) == 2
    (tmp_path / command.RESULTS).unlink()
    assert command.main(arguments) == command.OK
    assert capsys.readouterr().out == ""
    page = (tmp_path / command.RESULTS).read_text()
    assert all(f"| own |  | loss10 | {with_daemons} | 0.0 |  |" in page for with_daemons in (True, False))


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_missing_binary_is_refused(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before the first flight: the line names the variable."""
    assert f"set UAVLINKD_{kind.upper()} to" in refused(capsys, "--out", str(tmp_path), "--kind", kind)
    assert "UAVLINKD_ARDUPILOT or UAVLINKD_PX4" in refused(capsys, "--out", str(tmp_path))
