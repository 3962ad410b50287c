"""Processes and folders of the laboratory end with their parent, however that ends."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.imports import sources
from tests.processes.test_demo import is_running
from tests.waiting import until
from uavlinkd.lab.child_processes import end_with_parent, private_folder

SLEEP = "import time; print(flush=True); time.sleep(600)"
PARENT = f"""
import json, subprocess, sys, time
from uavlinkd.lab.child_processes import end_with_parent, private_folder
with private_folder("keys-") as folder:
    (folder / "drone.key").write_text("secret")
    child = subprocess.Popen(end_with_parent(sys.executable, "-c", {SLEEP!r}), stdout=subprocess.PIPE)
    child.stdout.readline()
    print(json.dumps([child.pid, str(folder)]), flush=True)
    time.sleep(600)
"""


def started() -> subprocess.Popen[bytes]:
    """A process with a child and a folder."""
    return subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE)


async def test_nothing_outlives_a_killed_parent() -> None:
    """SIGKILL gives the parent no time: the kernel ends the child, and another process removes the folder."""
    with started() as parent:
        assert parent.stdout is not None
        pid, name = json.loads(parent.stdout.readline())
        folder = Path(name)
        assert is_running(pid)
        assert (folder / "drone.key").exists()
        parent.kill()
        await until(lambda: not is_running(pid))
        await until(lambda: not folder.exists())


def test_child_of_a_parent_that_has_ended_does_not_start() -> None:
    """If the parent ends before the child has asked the kernel for the signal, the kernel sends none."""
    command = [*end_with_parent(sys.executable, "-c", "print('started')")]
    command[command.index(str(os.getpid()))] = "1"  # another parent than it finds
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert done.stdout == ""
    assert "the parent has ended" in done.stderr


def test_folder_is_private_and_removed_at_the_end() -> None:
    folders = []

    def fail() -> None:
        with private_folder("keys-") as folder:
            folders.append(folder)
            assert folder.stat().st_mode & 0o777 == 0o700
            (folder / "drone.key").write_text("secret")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not folders[0].exists()


def test_every_process_of_the_laboratory_ends_with_its_parent() -> None:
    """The evaluations start processes in many places."""
    unbound = []
    for name, source in sources("lab/"):
        calls = [ast.unparse(node) for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
        starts = [call for call in calls if call.startswith(("subprocess.Popen(", "asyncio.create_subprocess_"))]
        unbound += [name for call in starts if "end_with_parent(" not in call]
    assert unbound == ["lab/child_processes.py"]
