"""Two programs that talk through two daemons while something goes wrong, and what that cost them."""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

from tests.compose.cluster import socket_in
from tests.daemon.harness import PATIENCE_S, DaemonProcess, Sockaddr, Status, frame, open_socket
from tests.waiting import until

EVERY_S = 0.02
NOBODY = 99
"""The system of frames that nobody keeps account of."""
_SYSTEM_AT = 5


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a fault did."""

    did: str
    """What the daemon did meanwhile, with its own counts."""
    recovered_s: float
    """From the fault's end until all worked again."""
    lines: int
    """That the daemon logged from the fault's beginning until then."""


class Voice:
    """One program: says numbered frames in a steady rhythm, and notes when each of the other's comes."""

    def __init__(self, sock: socket.socket, into: Sockaddr, system: int, hears: int) -> None:
        self.sent_at: dict[int, float] = {}
        self.heard_at: dict[bytes, float] = {}
        self.copies = 0
        self._sock = sock
        self._into = into
        self._system = system
        self._hears = hears

    def frame(self, number: int) -> bytes:
        """Its frame with this number."""
        return frame(number, self._system)

    async def speak(self) -> None:
        """Say the next frame, and the next, without end."""
        loop = asyncio.get_running_loop()
        loop.add_reader(self._sock, self._on_readable)
        try:
            while True:
                number = len(self.sent_at)
                self.sent_at[number] = monotonic()
                with suppress(OSError):  # the daemon's port may be gone for a moment: nobody hears it
                    self._sock.sendto(self.frame(number), self._into)
                await asyncio.sleep(EVERY_S)
        finally:
            loop.remove_reader(self._sock)
            self._sock.close()

    def shout(self) -> None:
        """Say much, out of turn, that counts for nothing."""
        with suppress(OSError):
            self._sock.sendto(frame(0, NOBODY) * 8, self._into)

    def _on_readable(self) -> None:
        now = monotonic()
        with suppress(OSError):
            while True:
                data = self._sock.recv(65536)
                for start in range(0, len(data), len(self.frame(0))):
                    each = data[start : start + len(self.frame(0))]
                    if each[_SYSTEM_AT] == self._hears:  # the rest is nothing that is kept account of
                        self.copies += each in self.heard_at
                        self.heard_at.setdefault(each, now)


class Talk:
    """Between the programs of two daemons, which need an endpoint for it each: :func:`prepare` adds them."""

    def __init__(self, voices: tuple[Voice, Voice]) -> None:
        self.voices = voices
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Begin, and wait until each hears the other."""
        self._tasks = [asyncio.create_task(voice.speak()) for voice in self.voices]
        await until(lambda: all(voice.heard_at for voice in self.voices))

    def stop(self) -> None:
        """Fall silent."""
        for task in self._tasks:
            task.cancel()

    async def back(self, since: float) -> float:
        """Wait until each has heard what the other said after a moment; how long after it that was, in seconds."""
        async with asyncio.timeout(PATIENCE_S):
            while (found := self._back(since)) is None:  # noqa: ASYNC110  two sockets, any of which may bring it
                await asyncio.sleep(0.005)
        return found

    def _back(self, since: float) -> float | None:
        latest = 0.0
        for speaker, hearer in (self.voices, self.voices[::-1]):
            after = [number for number, at in speaker.sent_at.items() if at >= since]
            heard = [hearer.heard_at[each] for each in map(speaker.frame, after) if each in hearer.heard_at]
            if not heard:
                return None
            latest = max(latest, *(at - since for at in (min(heard),)))
        return latest

    def lost(self, since: float, before: float) -> int:
        """How many frames said in between were not heard."""
        return sum(
            speaker.frame(number) not in hearer.heard_at
            for speaker, hearer in (self.voices, self.voices[::-1])
            for number, at in speaker.sent_at.items()
            if since <= at < before
        )

    def check_no_copies(self) -> None:
        """Nothing was heard twice."""
        assert [voice.copies for voice in self.voices] == [0, 0]


def prepare(a: DaemonProcess, b: DaemonProcess, namespaces: tuple[Path | None, Path | None] = (None, None)) -> Talk:
    """Give each an endpoint, in its network namespace, and a program there."""
    voices = [
        Voice(
            open_socket("127.0.0.1") if namespace is None else socket_in(namespace),
            daemon.add_endpoint("talk"),
            system,
            3 - system,
        )
        for system, daemon, namespace in zip((1, 2), (a, b), namespaces, strict=True)
    ]
    return Talk((voices[0], voices[1]))


@dataclass(slots=True)
class Log:
    """What a daemon has logged since a moment."""

    daemon: DaemonProcess
    _begin: int = field(init=False)

    def __post_init__(self) -> None:
        self._begin = len(self.daemon.lines)

    @property
    def amount(self) -> int:
        """How many lines."""
        return len(self.daemon.lines) - self._begin


def grew(before: Status, after: Status, *path: str) -> dict[str, int]:
    """Which counters rose, and by how much."""
    old: Any = before
    new: Any = after
    for each in path:
        old, new = old[each], new[each]
    return {name: total - old.get(name, 0) for name, total in new.items() if total > old.get(name, 0)}


def told(counts: dict[str, int]) -> str:
    """For the table."""
    return ", ".join(f"{name} {amount}" for name, amount in sorted(counts.items())) or "nothing"
