"""Each command is killed at each change of a file, and run again: no serial is used twice, and nothing is lost."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.fleet.folders import create
from tests.killed_commands import KILLED, Stage
from uavlinkd.authority.certificates import parse_certificate
from uavlinkd.fleet.authority_key import load_key, paper_copy
from uavlinkd.fleet.manifest import read_manifest
from uavlinkd.system.addresses import Address
from uavlinkd.system.base64_text import from_base64

pytestmark = pytest.mark.long


def serials_in_files(folder: Path) -> set[int]:
    """The serials of all certificates that some member's configuration has as its own."""
    tables = [tomllib.loads(path.read_text()) for path in folder.rglob("*.toml") if path.name != "fleet.toml"]
    return {
        parse_certificate(from_base64(table["fleet"]["certificate"])).serial for table in tables if "fleet" in table
    }


def check(folder: Path) -> None:
    """Every certificate is known by one name, no two have one serial, and nothing is left beside the files."""
    fleet = read_manifest(folder / "fleet")
    serials = [member.certificate.serial for member in fleet.members]
    assert len(set(serials)) == len(serials)
    assert max(serials) < fleet.next_serial
    assert serials_in_files(folder) <= set(serials)
    names = [member.name for member in fleet.current]
    assert len(set(names)) == len(names)
    assert not [path for path in folder.rglob(".*") if path.name.endswith((".new", ".old")) or path.is_dir()]


PAPER = "paper"
COMMANDS: list[tuple[str, list[str], str]] = [
    # The command; those before it, each of which reads the line of the one before; and what it reads.
    ("fleet remove drone1", [], ""),
    ("fleet sign --id 7", ["enroll v7"], "line"),
    ("fleet enroll v7 --here", [], ""),
    ("enroll v7", [], ""),
    ("enroll --finish", ["enroll v7", "fleet sign --id 7"], "line"),
    (
        "enroll --finish",
        ["enroll v7", "fleet sign", "enroll --finish", "enroll v7", "fleet sign --replace v7"],
        "line",
    ),
    ("fleet restore --no-passphrase", [], PAPER),
    ("fleet init --out fleet2 --no-passphrase", [], ""),
]


@pytest.mark.parametrize(("command", "before", "reads"), COMMANDS, ids=[command for command, _, _ in COMMANDS])
def test_killed_at_each_change_and_run_again(tmp_path: Path, command: str, before: list[str], reads: str) -> None:
    """After the second run all is as after one that was not killed, but for keys and serials."""
    made = Stage(tmp_path / "made")
    create(made.folder / "fleet", drones=2, relays=(Address("relay.example.org", 5790),))
    line = ""
    for each in before:
        status, line = made.run(each, line)
        assert status == 0
    if reads == PAPER:
        line = paper_copy(load_key(made.folder / "fleet" / "authority.pem", _unasked))
        (made.folder / "fleet" / "authority.pem").unlink()
    whole = copy_of(made, tmp_path / "whole")
    done = 1 if "remove" in command else 0  # it is signed, and no daemon is here to hear of it
    assert whole.run(command, line)[0] == done
    check(whole.folder)
    killed = 0
    while True:
        stage = copy_of(made, tmp_path / f"{killed}")
        status, _ = stage.run(command, line, kill_at=killed)
        if status != KILLED:
            break
        killed += 1
        status, output = stage.run(command, line)
        assert status == done, (killed, output)
        check(stage.folder)
        assert names(stage.folder) == names(whole.folder)
    assert killed >= 2


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def copy_of(made: Stage, folder: Path) -> Stage:
    stage = Stage(folder)
    shutil.copytree(made.folder, folder, dirs_exist_ok=True)
    return stage


def _unasked(what: str) -> Any:
    raise AssertionError(what)
