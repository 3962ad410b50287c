"""Two linked daemons in one process, and frames that go from a client of the one to a client of the other.

Started by :mod:`.count` under callgrind. The callbacks that the daemons gave to the loop are called here, one after
the other, so that exactly the work of one end is counted.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from tests.daemon_pair import ANY_PORT, are_linked, attitude, config
from tests.mavlink.signing.autopilot import Autopilot
from tests.mavlink.signing.wire import KEY, keyed
from tests.waiting import until
from uavlinkd.config.model import Config, SigningConfig
from uavlinkd.daemon.daemon import Daemon
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.system.addresses import Address

SIDES: Final = ("sending", "receiving")
WARM_UP: Final = 60
SETTLES_S: Final = 5.0
"""Work of the first seconds without frames is not counted: it is done once."""


class Loop(asyncio.SelectorEventLoop):
    """An event loop that knows the callback of each UDP socket, by its port."""

    def __init__(self) -> None:
        super().__init__()
        self.callbacks: dict[int, Callable[[], object]] = {}

    def add_reader(self, fd: Any, callback: Callable[..., Any], *args: Any) -> None:  # type: ignore[override]
        super().add_reader(fd, callback, *args)
        if isinstance(fd, socket.socket) and fd.type == socket.SOCK_DGRAM and fd.family == socket.AF_INET:
            self.callbacks[fd.getsockname()[1]] = lambda: callback(*args)


class Counting:
    """The library of ``counting.c``. Without callgrind its functions do nothing."""

    def __init__(self, library: str) -> None:
        self._library = ctypes.CDLL(library)
        self.cool, self.toggle, self.begin = self._library.cool, self._library.toggle, self._library.begin

    def dump(self, name: str) -> None:
        self._library.dump(name.encode())


def open_client() -> socket.socket:
    """The socket of a client."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


class Pair:
    """The daemons ``left`` and ``right``, and a client of each. ``signs``: both clients are autopilots with a key."""

    def __init__(self, loop: Loop, counting: Counting, *, signs: bool) -> None:
        self._loop, self._counting, self._signs = loop, counting, signs
        self._signer = keyed(Autopilot())
        self._client, self._ground = open_client(), open_client()
        self._number = 0

    async def start(self) -> None:
        """Link the daemons."""
        callbacks = self._loop.callbacks
        ground = NetworkUrl(EndpointKind.UDPOUT, Address(*self._ground.getsockname()))
        right = Daemon(self._config(config("right", ground)))
        await right.start()
        (called,) = right.parts.peer_sockets.addresses
        before = set(callbacks)
        left = Daemon(self._config(config("left", NetworkUrl(EndpointKind.UDPIN, ANY_PORT), (called,))))
        await left.start()
        await until(lambda: are_linked(left, right))
        own = {address.port for address in left.parts.peer_sockets.addresses}
        (self._client_port,) = set(callbacks) - before - own
        self._receive = {"sending": callbacks[self._client_port], "receiving": callbacks[called.port]}
        if self._signs:
            (outgoing,) = set(callbacks) - own - {self._client_port, called.port}
            await self._prove(left, self._client, self._client_port, self._signer)
            await self._prove(right, self._ground, outgoing, keyed(Autopilot()))

    def _config(self, plain: Config) -> Config:
        keys = SigningConfig(KEY) if self._signs else None
        return replace(plain, endpoints=tuple(replace(one, signing=keys) for one in plain.endpoints))

    async def _prove(self, daemon: Daemon, sock: socket.socket, port: int, autopilot: Autopilot) -> None:
        (endpoint,) = daemon.parts.local.endpoints
        while not any(port.is_genuine for port in endpoint.ports):
            sock.sendto(autopilot.heartbeat(), ("127.0.0.1", port))
            await asyncio.sleep(0.05)
            with suppress(BlockingIOError):
                for answer in autopilot.receive(sock.recv(2048)):
                    sock.sendto(answer, ("127.0.0.1", port))
            await asyncio.sleep(0.05)

    def _frame(self) -> bytes:
        if not self._signs:
            return attitude(self._number)
        return self._signer.send(mavlink.MAVLink_attitude_message(self._number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1))

    async def carry(self, frames: int, counted: str) -> None:
        """Carry frames, and count what one side does; none if it is empty. RuntimeError: most are lost."""
        arrived = 0
        for _ in range(frames):
            self._number += 1
            self._client.sendto(self._frame(), ("127.0.0.1", self._client_port))
            for side in SIDES:
                self._call(self._receive[side], is_counted=side == counted)
            with suppress(BlockingIOError):
                while True:
                    arrived += bool(self._ground.recv(2048))
            await asyncio.sleep(0.001)
        if arrived < frames / 2:
            raise RuntimeError(f"{arrived} of {frames} frames arrived")

    def _call(self, callback: Callable[[], object], *, is_counted: bool) -> None:
        if not is_counted:
            callback()
            return
        self._counting.cool()
        self._counting.toggle()
        callback()
        self._counting.toggle()
        self._counting.dump("frame")


async def run(loop: Loop, counting: Counting, frames: int, idle_s: float, *, signs: bool) -> None:
    """Count each side, and then both while nothing is sent."""
    pair = Pair(loop, counting, signs=signs)
    await pair.start()
    await asyncio.sleep(0.2)
    gc.collect()
    counting.begin()
    await pair.carry(WARM_UP, "")
    for side in SIDES:
        await pair.carry(frames, side)
    if idle_s:
        await asyncio.sleep(SETTLES_S)
        counting.toggle()
        await asyncio.sleep(idle_s)
        counting.toggle()
        counting.dump("idle")


def main() -> None:
    """``pair LIBRARY FRAMES IDLE_S [signs]``."""
    loop = Loop()
    library, frames, idle_s, *signs = sys.argv[1:]
    gc.disable()
    loop.run_until_complete(run(loop, Counting(library), int(frames), float(idle_s), signs=bool(signs)))


if __name__ == "__main__":
    main()
