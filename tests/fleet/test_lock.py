"""Two fleet commands on one folder: the second, a real process, waits for the first."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import FleetSettings, MemberKind, read_manifest
from uavlinkd.fleet.transaction import check_members, lock
from uavlinkd.lab.child_processes import end_with_parent

COMMAND = end_with_parent(sys.executable, "-m", "uavlinkd", "fleet", "add", "scout", "--out", "fleet")


@pytest.mark.long
@pytest.mark.parametrize("is_interrupted", [False, True])
def test_second_command_waits_for_the_first(tmp_path: Path, is_interrupted: bool) -> None:
    """It reads the files only when it has the lock, so it keeps the first's change. Ctrl-C ends the wait."""
    fleet, changed = tmp_path / "fleet", tmp_path / "changed"
    operations.init(fleet, FleetSettings(), drones=2, ground_stations=0, observers=0)
    shutil.copytree(fleet, changed)
    operations.add(changed, "relay", MemberKind.DRONE)
    with ExitStack() as stack:
        held = stack.enter_context(ExitStack())
        held.enter_context(lock(fleet))
        second = stack.enter_context(
            subprocess.Popen(COMMAND, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        )
        stack.callback(second.kill)
        assert second.stderr is not None
        assert second.stderr.readline() == "waiting for another fleet command in fleet\n"
        shutil.copytree(changed, fleet, dirs_exist_ok=True)
        if is_interrupted:
            second.send_signal(signal.SIGINT)
        else:
            held.close()
        assert second.wait(PATIENCE_S) == is_interrupted
    members = read_manifest(fleet).members
    assert [member.name for member in members] == ["drone1", "drone2", "relay", *["scout"] * (not is_interrupted)]
    assert len({member.system_id for member in members}) == len(members)
    check_members(fleet, members)
