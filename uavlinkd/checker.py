"""Starting the process that checks a configuration (:mod:`uavlinkd.config.reader`), before anything else is imported.

It takes longer than the daemon does to import what it needs: the sooner it begins, the sooner the daemon is ready.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


def start_checking(path: Path) -> subprocess.Popen[bytes]:
    """A process that reads one file and writes what it found to its standard output."""
    return subprocess.Popen(  # noqa: S603  this interpreter, and a path that is only an argument
        checker_command(path), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE
    )


def checker_command(path: Path) -> tuple[str, ...]:
    """The same as a command line."""
    return *interpreter(), "-m", "uavlinkd.config", str(path)


def interpreter() -> tuple[str, ...]:
    """How to start this Python again for a module: it imports nothing from the current folder, unless we do too."""
    here = {""}
    with suppress(OSError):  # the current folder was deleted
        here.add(os.getcwd())
    return (sys.executable,) if sys.path[0] in here else (sys.executable, "-P")
