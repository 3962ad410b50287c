"""What is measured: how each is started on both hosts, and where its frames go in."""

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

from tests.bench.namespaces import Cable, Host
from tests.bench.traffic import REPOSITORY, SINK_PORT

INTO_PORT: Final = 14550
"""Where the left side takes frames, on loopback."""
LINK_PORT: Final = 5790
"""Where the right side listens on the cable."""
INTO: Final = ("127.0.0.1", INTO_PORT)
LOCAL_SINK: Final = f"127.0.0.1:{SINK_PORT}"


class NotMeasuredError(Exception):
    """Why a contender is not: what it needs is not there, or it does not work here. For a person."""


@dataclass(slots=True)
class Running:
    """A contender at work: its processes by side, and where frames are sent to."""

    left: list[subprocess.Popen[bytes]]
    right: list[subprocess.Popen[bytes]]
    target: tuple[str, int] = INTO


class Contender(ABC):
    """One way from a program on the left to a program on the right."""

    def __init__(self, name: str, about: str) -> None:
        self.name = name
        self.about = about

    def why_not(self) -> str | None:
        """Why it cannot be measured here; None where it can."""
        return None

    def version(self) -> str | None:
        """Of the program, where it has one of its own."""
        return None

    @abstractmethod
    def start(self, cable: Cable, folder: Path) -> Running:
        """Start both sides; the folder is empty, and for nothing else. Logs in it are named ``*.log``.

        Raises:
            NotMeasuredError: it does not start.
        """


class Relay(Contender):
    """An empty relay of :mod:`tests.bench.relays`, a process on each side."""

    def __init__(self, kind: str, about: str) -> None:
        super().__init__(f"relay-{kind}", about)
        self._kind = kind

    def why_not(self) -> str | None:
        return needs_module("uvloop") if self._kind == "uvloop" else None

    def start(self, cable: Cable, folder: Path) -> Running:
        right = self._start(cable.right, LINK_PORT, ("127.0.0.1", SINK_PORT), folder)
        left = self._start(cable.left, INTO_PORT, (cable.right.address, LINK_PORT), folder)
        return Running([left], [right])

    def _start(self, host: Host, port: int, to: tuple[str, int], folder: Path) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.bench.relays", self._kind, str(port), to[0], str(to[1])]
        return host.start(command, folder=REPOSITORY, log=folder / f"{host.name}.log")


class Direct(Contender):
    """Nothing at all: the generator sends straight to the sink, over the cable. What plain UDP takes."""

    def __init__(self) -> None:
        super().__init__("plain-udp", "no program between: generator, cable, sink")

    def start(self, cable: Cable, folder: Path) -> Running:
        return Running([], [], (cable.right.address, SINK_PORT))


def needs_module(name: str) -> str | None:
    """Why what takes this Python package cannot be measured."""
    return None if find_spec(name) else f"the Python package {name} is not installed"


def needs_program(*names: str) -> str | None:
    """Why what takes these programs cannot be measured."""
    missing = [name for name in names if shutil.which(name) is None]
    return f"not installed: {', '.join(missing)}" if missing else None


def program_version(*command: str) -> str | None:
    """What a program says its version is; None where it does not say."""
    shown = subprocess.run(command, capture_output=True, text=True, check=False)
    found = re.search(r"\d+(?:\.\d+)+", shown.stdout + shown.stderr)
    return found[0] if found else None


def last_words(folder: Path) -> str:
    """The last line of each log, for the one who looks for the reason."""
    ends = [path.read_text(errors="replace").strip().rpartition("\n")[2] for path in sorted(folder.rglob("*.log"))]
    return "".join(f"; it said: {end[:300]}" for end in ends if end)


def until(condition: Callable[[], bool], what: str, timeout_s: float = 20.0) -> None:
    """Wait for it.

    Raises:
        NotMeasuredError: it does not happen.
    """
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            raise NotMeasuredError(f"not in {timeout_s:g} s: {what}")
        time.sleep(0.02)


def all_contenders() -> Sequence[Contender]:
    """Every one that is known, the baselines first."""
    from tests.bench.daemons import DAEMONS
    from tests.bench.routers import PROGRAMS
    from tests.bench.tunnels import TUNNELS

    return (
        Direct(),
        Relay("uvloop", "empty relay: uvloop, DatagramProtocol"),
        Relay("blocking", "empty relay: blocking sockets"),
        Relay("add-reader", "empty relay: asyncio, add_reader, socket drained"),
        Relay("asyncio", "empty relay: asyncio, DatagramProtocol"),
        *DAEMONS,
        *TUNNELS,
        *PROGRAMS,
    )
