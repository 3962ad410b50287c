"""The contenders: how each starts on both hosts, and where its frames enter."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from tests.bench.cable import Cable, Host
from tests.bench.traffic import REPOSITORY, SINK_PORT

INTO_PORT: Final = 14550
"""Where the left side receives frames, on loopback."""
LINK_PORT: Final = 5790
"""Where the right side listens on the cable."""
INTO: Final = ("127.0.0.1", INTO_PORT)
LOCAL_SINK: Final = f"127.0.0.1:{SINK_PORT}"


class NotMeasuredError(Exception):
    """The reason why a contender cannot run here, for a person."""


@dataclass(slots=True)
class Running:
    """A running contender: its processes by side, and the destination of frames."""

    left: list[subprocess.Popen[bytes]]
    right: list[subprocess.Popen[bytes]]
    target: tuple[str, int] = INTO


class Contender(ABC):
    """A path from a client on the left to a client on the right."""

    def __init__(self, name: str) -> None:
        self.name = name

    def why_not(self) -> str | None:
        """The reason why it cannot be measured here, or None."""
        return None

    def version(self) -> str | None:
        """The version of its executable, if it has one of its own."""
        return None

    @abstractmethod
    def start(self, cable: Cable, folder: Path) -> Running:
        """Start both sides; the folder is empty, and for nothing else. Logs in it are named ``*.log``.

        Raises:
            NotMeasuredError: it does not start.
        """


class Relay(Contender):
    """The empty relay of :mod:`tests.bench.relays`, a process on each side."""

    def why_not(self) -> str | None:
        return needs_module("uvloop")

    def start(self, cable: Cable, folder: Path) -> Running:
        right = self.start_one(cable.right, LINK_PORT, ("127.0.0.1", SINK_PORT), folder)
        left = self.start_one(cable.left, INTO_PORT, (cable.right.address, LINK_PORT), folder)
        return Running([left], [right])

    def start_one(self, host: Host, port: int, to: tuple[str, int], folder: Path) -> subprocess.Popen[bytes]:
        """A relay from a port of a host to an address."""
        command = [sys.executable, "-m", "tests.bench.relays", str(port), to[0], str(to[1])]
        return host.start(command, folder=REPOSITORY, log=folder / f"{host.name}.log")


def needs_module(name: str) -> str | None:
    """The reason why contenders that need this Python package cannot be measured, or None."""
    return None if find_spec(name) else f"the Python package {name} is not installed"


def needs_command(*names: str) -> str | None:
    """The reason why contenders that need these commands cannot be measured, or None."""
    missing = [name for name in names if shutil.which(name) is None]
    return f"not installed: {', '.join(missing)}" if missing else None


def command_version(*command: str) -> str | None:
    """The version that a command prints, or None."""
    shown = subprocess.run(command, capture_output=True, text=True, check=False)
    match = re.search(r"\d+(?:\.\d+)+", shown.stdout + shown.stderr)
    return match[0] if match else None


def last_words(folder: Path) -> str:
    """The last line of each log, for a person who looks for the reason."""
    ends = [path.read_text(errors="replace").strip().rpartition("\n")[2] for path in sorted(folder.rglob("*.log"))]
    return "".join(f"; it said: {end[:300]}" for end in ends if end)


def until(condition: Callable[[], bool], what: str, timeout_s: float = 20.0) -> None:
    """Wait for a condition. Raises NotMeasuredError if it does not happen."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            raise NotMeasuredError(f"not in {timeout_s:g} s: {what}")
        time.sleep(0.02)


def all_contenders() -> Sequence[Contender]:
    from tests.bench.daemons import DAEMONS
    from tests.bench.tunnels import TUNNELS

    return (Relay("relay-uvloop"), *DAEMONS, *TUNNELS)
