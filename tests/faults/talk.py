"""Two clients that exchange frames through two daemons during a fault, and their losses."""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.namespaces import udp_socket_in
from tests.processes.frames import frame, frames_in
from tests.processes.losses import lost_to_waiting
from tests.processes.process import DaemonProcess, Status
from tests.processes.udp import Sockaddr, open_socket
from tests.samples import pack
from tests.waiting import PATIENCE_S, Stopwatch, until

EVERY_S = 0.02
UNCOUNTED = 99
"""The system of frames that are not counted."""
_SYSTEM_AT = 5


@dataclass(frozen=True, slots=True)
class Outcome:
    did: str
    """What the daemon did meanwhile, with its own counts."""
    recovered_s: float
    """From the fault's end until all worked again."""
    lines: int
    """That the daemon logged from the fault's beginning until then."""


class Voice:
    """One client: says numbered frames in a steady rhythm, and notes when each of the other's comes."""

    def __init__(self, sock: socket.socket, into: Sockaddr, system: int, hears: int) -> None:
        self.sent_at: dict[int, float] = {}
        self.received_at: dict[bytes, float] = {}
        self.copies = 0
        self._sock = sock
        self._into = into
        self.system = system
        self._hears = hears

    def frame(self, number: int) -> bytes:
        return frame(number, self.system)

    def sent_between(self, since: float, before: float) -> list[int]:
        """The numbers of the frames that were sent in this time."""
        return [number for number, at in self.sent_at.items() if since <= at < before]

    async def speak(self) -> None:
        """Say the next frame, and the next, without end, and listen."""
        listening = asyncio.create_task(self.listen())
        try:
            while True:
                number = len(self.sent_at)
                self.sent_at[number] = monotonic()
                with suppress(OSError):  # the daemon's port may be gone for a moment: the frame is lost
                    self._sock.sendto(self.frame(number), self._into)
                await asyncio.sleep(EVERY_S)
        finally:
            listening.cancel()

    async def listen(self) -> None:
        """Note the other's frames, without end."""
        loop = asyncio.get_running_loop()
        loop.add_reader(self._sock, self._on_readable)
        try:
            await loop.create_future()
        finally:
            loop.remove_reader(self._sock)
            self._sock.close()

    def shout(self) -> None:
        """Say much, out of turn, that counts for nothing."""
        with suppress(OSError):
            self._sock.sendto(frame(0, UNCOUNTED) * 8, self._into)

    def _on_readable(self) -> None:
        now = monotonic()
        with suppress(OSError):
            while True:
                for raw in frames_in(self._sock.recv(65536)):
                    if raw[_SYSTEM_AT] == self._hears:  # the rest is nothing that is kept account of
                        self.copies += raw in self.received_at
                        self.received_at.setdefault(raw, now)


class Talk:
    """Between the clients of two daemons, which need an endpoint for it each: :func:`prepare` adds them."""

    def __init__(self, voices: tuple[Voice, Voice]) -> None:
        self.voices = voices
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Begin, and wait until each hears the other."""
        self._tasks = [asyncio.create_task(voice.speak()) for voice in self.voices]
        await until(lambda: all(voice.received_at for voice in self.voices))

    def stop(self) -> None:
        for task in self._tasks:
            task.cancel()

    async def back(self, since: float) -> float:
        """Wait until each has received a frame that the other sent after this time, which is now or just was.

        Returns:
            Seconds from then, without those in which the machine was busy.
        """
        watch = Stopwatch()
        elapsed_s = await self.elapsed_until_back(since)
        return max(0.0, elapsed_s - watch.contended_s)

    async def elapsed_until_back(self, since: float) -> float:
        """The same, with the seconds in which the machine was busy."""
        async with asyncio.timeout(PATIENCE_S):
            while (back_s := self._back(since)) is None:  # noqa: ASYNC110  two sockets, any of which may bring it
                await asyncio.sleep(0.005)
        return back_s

    def _back(self, since: float) -> float | None:
        latest = 0.0
        for speaker, hearer in (self.voices, self.voices[::-1]):
            after = [number for number, at in speaker.sent_at.items() if at >= since]
            received = [hearer.received_at[raw] for raw in map(speaker.frame, after) if raw in hearer.received_at]
            if not received:
                return None
            latest = max(latest, *(at - since for at in (min(received),)))
        return latest

    def lost(self, since: float, before: float) -> int:
        """The number of frames sent in between that were not received."""
        return sum(
            speaker.frame(number) not in hearer.received_at
            for speaker, hearer in (self.voices, self.voices[::-1])
            for number in speaker.sent_between(since, before)
        )

    async def check_lost_none(self, since: float, before: float, a: DaemonProcess, b: DaemonProcess) -> None:
        """Assert that the daemons lost no frame sent in between, once a later one has arrived in each direction.

        Frames that were lost because a daemon had to wait for a processor are not lost by the link.
        """
        await self.back(before)
        lost = self.lost(since, before)
        dropped = await lost_to_waiting(a, b) + await lost_to_waiting(b, a)
        assert lost <= dropped, f"{lost} frames lost, {dropped} of them explained"

    def check_no_copies(self) -> None:
        assert [voice.copies for voice in self.voices] == [0, 0]


class CriticalVoice(Voice):
    """A client whose frames go along every usable path: STATUSTEXT."""

    def frame(self, number: int) -> bytes:
        return pack(mavlink.MAVLink_statustext_message(6, b"%050d" % (number + 1)), self.system, seq=number)


def prepare(
    a: DaemonProcess,
    b: DaemonProcess,
    namespaces: tuple[Path | None, Path | None] = (None, None),
    voice: type[Voice] = Voice,
) -> Talk:
    """Give each an endpoint, in its network namespace, and a client there."""
    voices = [
        voice(
            open_socket("127.0.0.1") if namespace is None else udp_socket_in(namespace),
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
    def count(self) -> int:
        return len(self.daemon.lines) - self._begin


def grew(before: Status, after: Status, *path: str) -> dict[str, int]:
    """Which counters rose, and by how much."""
    old: Any = before
    new: Any = after
    for key in path:
        old, new = old[key], new[key]
    return {name: total - old.get(name, 0) for name, total in new.items() if total > old.get(name, 0)}


def reported(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items())) or "nothing"
