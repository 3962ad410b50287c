"""The command lines of the flights: what cannot be flown is one line and exit status 2, without a simulator."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from tests.sitl import command, roles
from tests.sitl.scenarios import Record, Run, runs

EXECUTABLE = "/bin/sh"


@pytest.fixture(autouse=True)
def no_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment names no simulator, and nothing flies."""
    for name in ("UAVLINKD_ARDUPILOT", "UAVLINKD_PX4"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(command, "fly_quietly", passed)


def passed(run: Run, _: Path) -> Record:
    """The record of a run that passed, without its flight."""
    frames = {way: {"lost": 1, "sent": 10} for way in ("down", "up")}
    return Record(run.scenario, run.kind, run.condition, run.with_daemons, figures={"frames": frames})


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The error of a command line."""
    assert command.main(arguments) == command.USAGE
    shown = capsys.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    return line


def test_own_simulator_has_runs() -> None:
    """It needs no binary, and flies what it has the protocols for."""
    assert {run.scenario for run in runs(("own",))} == {
        *("parameters-mission", "flight", "two-vehicles", "relay", "relay-nat", "two-relays")
    }


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
    arguments = ("--out", str(tmp_path), "--kind", "own", "--scenario", "flight", "--condition", "loss10")
    assert command.main(arguments) == command.OK
    assert len(capsys.readouterr().out.splitlines()) == 2
    (tmp_path / command.RESULTS).unlink()
    assert command.main(arguments) == command.OK
    assert capsys.readouterr().out == ""
    assert "| uavlinkd sim |  | 2 | 2 |" in (tmp_path / command.RESULTS).read_text()


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_missing_binary_is_refused(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Before the first flight: the line names the variable."""
    assert f"set UAVLINKD_{kind.upper()} to" in refused(capsys, "--out", str(tmp_path), "--kind", kind)
    assert "UAVLINKD_ARDUPILOT or UAVLINKD_PX4" in refused(capsys, "--out", str(tmp_path))


@pytest.mark.parametrize("selection", [(), ("--kind", "px4")])
def test_wrong_binary_is_refused(
    selection: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The line names the variable and the path."""
    monkeypatch.setenv("UAVLINKD_PX4", str(tmp_path / "px4"))
    line = refused(capsys, "--out", str(tmp_path), *selection)
    assert f"UAVLINKD_PX4: {tmp_path / 'px4'} is not an executable file" in line


def test_folder_that_cannot_be_created_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The line names it."""
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / "out"
    assert str(folder) in refused(capsys, "--out", str(folder), "--kind", "own")


@pytest.mark.parametrize("line", ['{"scenario": "fli', "{}", "1"])
def test_invalid_line_is_refused(line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A write that was interrupted: the message names the file and the line's number."""
    good = json.dumps(asdict(Record("flight", "own", "clean", True, error="it fell")))
    (tmp_path / command.RECORDS).write_text(f"{good}\n{line}")
    assert f"{command.RECORDS}, line 2 is not a record" in refused(capsys, "--out", str(tmp_path), "--report")


def test_report_without_records_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """There is nothing to write."""
    assert "no records" in refused(capsys, "--out", str(tmp_path), "--report")
    assert not (tmp_path / command.RESULTS).exists()


def test_roles_refuse_a_wrong_binary(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, not after the time that a simulator has for its start."""
    monkeypatch.setenv("UAVLINKD_ARDUPILOT", str(tmp_path / "arducopter"))
    with pytest.raises(SystemExit, match="2"):
        roles.main([])
    assert "arducopter is not an executable file" in capsys.readouterr().err
