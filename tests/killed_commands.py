"""Commands that are killed at a change of a file."""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path
from typing import Any

from uavlinkd.cli import main

KILLED = 137
CHANGES = frozenset({"os.rename", "os.remove", "os.link", "os.mkdir", "os.rmdir", "os.chmod", "os.truncate"})
"""Audit events of changes (PEP 578), beside an `open` for writing."""


class Stage:
    """A folder, and commands that run there in processes of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()

    def run(self, command: str, line: str = "", kill_at: int | None = None) -> tuple[int, str]:
        """The exit status and the standard output. ``kill_at``: before the change of this number."""
        reading, writing = os.pipe()
        if not (child := os.fork()):
            self._run(command, line, kill_at, writing)
        os.close(writing)
        with open(reading) as pipe:
            output = pipe.read()
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), output

    def _run(self, command: str, line: str, kill_at: int | None, output: int) -> None:
        status = 1
        try:
            os.chdir(self.folder)
            os.dup2(output, 1)
            sys.stdin, sys.stdout = io.StringIO(line), os.fdopen(1, "w")
            changes = 0

            def count(event: str, arguments: tuple[Any, ...]) -> None:
                nonlocal changes
                writes = (
                    event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
                )
                if (event in CHANGES or writes) and "/dev/" not in str(arguments[0]):
                    if changes == kill_at:
                        os._exit(KILLED)
                    changes += 1

            if kill_at is not None:
                sys.addaudithook(count)
            status = main(command.split())
            sys.stdout.flush()
        finally:
            os._exit(status)
