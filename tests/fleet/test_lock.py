"""Two fleet commands on one folder: the second waits for the first. The commands are real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import FleetSettings, read_manifest
from uavlinkd.fleet.transaction import check_members
from uavlinkd.lab.child_processes import end_with_parent

pytestmark = pytest.mark.long

WAITING = "waiting for another fleet command in fleet\n"


class Commands:
    """Fleet commands that run beside each other, in the folder that holds the fleet ``fleet``."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._processes: list[subprocess.Popen[str]] = []
        self.fleet = place / "fleet"
        operations.init(self.fleet, FleetSettings(), drones=2, ground_stations=0, observers=0)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start ``uavlinkd fleet`` with these arguments."""
        process = subprocess.Popen(
            end_with_parent(sys.executable, "-m", "uavlinkd", "fleet", *arguments, "--out", "fleet"),
            cwd=self._place,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._processes.append(process)
        return process

    def start_blocked(self, *arguments: str) -> tuple[subprocess.Popen[str], int]:
        """Start a command that stops while it reads drone1's configuration, until the pipe is closed.

        The configuration is a named pipe when the command opens it. Afterwards it is the file from before again.
        """
        path = self.fleet / "drone1" / "drone1.toml"
        kept = path.rename(self._place / "kept.toml")
        os.mkfifo(path)
        process = self.start(*arguments)
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                pipe = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
                break
            except OSError:  # the command has not opened it yet
                assert time.monotonic() < deadline
                assert process.poll() is None, process.stderr and process.stderr.read()
                time.sleep(0.01)
        kept.rename(path)
        return process, pipe

    def end(self) -> None:
        """Kill the commands that still run."""
        for process in self._processes:
            process.kill()
            process.communicate()


@pytest.fixture
def commands(tmp_path: Path) -> Iterator[Commands]:
    """A fleet of two drones."""
    commands = Commands(tmp_path)
    try:
        yield commands
    finally:
        commands.end()


def first_line_of_errors(process: subprocess.Popen[str]) -> str:
    """Wait for a line on standard error. The text is empty if the command ends without one."""
    assert process.stderr is not None
    return process.stderr.readline()


def test_second_command_waits_and_keeps_the_change_of_the_first(commands: Commands) -> None:
    """Both members are in the manifest and in all configurations."""
    first, pipe = commands.start_blocked("add", "scout")
    second = commands.start("add", "relay")
    message = first_line_of_errors(second)
    os.write(pipe, (commands.fleet / "drone1" / "drone1.toml").read_bytes())
    os.close(pipe)
    assert first.wait(PATIENCE_S) == 0
    assert second.wait(PATIENCE_S) == 0
    assert message == WAITING
    fleet = read_manifest(commands.fleet)
    assert {member.name for member in fleet.members} == {"drone1", "drone2", "scout", "relay"}
    assert len({member.system_id for member in fleet.members}) == 4
    check_members(commands.fleet, fleet.members)
    for member in fleet.members:
        text = (commands.fleet / member.name / f"{member.name}.toml").read_text()
        assert all(other.public_key in text for other in fleet.peers_of(member))


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_command_that_is_ended_leaves_no_lock(commands: Commands, end: signal.Signals) -> None:
    """The waiting command continues, and no file of the lock is left."""
    first, pipe = commands.start_blocked("add", "scout")
    second = commands.start("remove", "drone2")
    message = first_line_of_errors(second)
    first.send_signal(end)
    assert first.wait(PATIENCE_S) != 0
    os.close(pipe)
    assert second.wait(PATIENCE_S) == 0
    assert message == WAITING
    assert [member.name for member in read_manifest(commands.fleet).members] == ["drone1"]
    assert {path.name for path in commands.fleet.iterdir()} == {"fleet.toml", "drone1", "drone2"}


def test_waiting_command_can_be_interrupted(commands: Commands) -> None:
    """Ctrl-C ends a command that waits, and changes nothing."""
    _, pipe = commands.start_blocked("add", "scout")
    second = commands.start("remove", "drone2")
    message = first_line_of_errors(second)
    second.send_signal(signal.SIGINT)
    assert second.wait(PATIENCE_S) == 1
    os.close(pipe)
    assert message == WAITING
    assert "drone2" in {member.name for member in read_manifest(commands.fleet).members}
