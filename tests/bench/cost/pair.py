"""Two linked daemons in one process, and a frame that goes from a client of the one to a client of the other.

Started by :mod:`.count` under callgrind. The callbacks that the daemons gave to the loop are called here, one after
the other, so that exactly the work of one end is counted.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import json
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from tests.waiting import until
from uavlinkd.config.model import Config, EndpointConfig, Log, PeerAddress, PeerConfig
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.endpoints.url import EndpointKind, NetworkUrl
from uavlinkd.link.daemon import Daemon
from uavlinkd.system.addresses import Address

ANY_PORT: Final = Address("127.0.0.1", 0)
KEYS: Final = {"left": KeyPair(bytes([1]) * 32), "right": KeyPair(bytes([2]) * 32)}
PRIVATE: Final = {"left": bytes([1]) * 32, "right": bytes([2]) * 32}
RULES: Final[dict[str, dict[str, Any]]] = {
    "left": {"role": "vehicle", "system_ids": [1]},
    "right": {"role": "operator", "system_ids": [255]},
}
SIDES: Final = ("sending", "receiving")
WARM_UP: Final = 60


class Loop(asyncio.SelectorEventLoop):
    """An event loop that knows the callback of each socket."""

    def __init__(self) -> None:
        super().__init__()
        self.callbacks: dict[int, Callable[[], object]] = {}

    def add_reader(self, fd: Any, callback: Callable[..., Any], *args: Any) -> None:  # type: ignore[override]
        super().add_reader(fd, callback, *args)
        self.callbacks[fd if isinstance(fd, int) else fd.fileno()] = lambda: callback(*args)


class Counting:
    """The library of ``counting.c``. Without callgrind its functions do nothing."""

    def __init__(self, library: str) -> None:
        self._library = ctypes.CDLL(library)
        self.cool, self.toggle, self.begin = self._library.cool, self._library.toggle, self._library.begin

    def dump(self, name: str) -> None:
        self._library.dump(name.encode())


def config(
    name: str, peer: str, listen: tuple[Address, ...], url: NetworkUrl, addresses: tuple[Address, ...]
) -> Config:
    """A daemon with one client and one peer."""
    settings = PeerSettings(peer, KEYS[peer].public, None, Link())
    return Config(
        path=Path(name),
        name=name,
        private_key=Secret(PRIVATE[name]),
        public_key=KEYS[name].public,
        listen=listen,
        endpoints=(EndpointConfig("client", url),),
        peers=(PeerConfig(settings, tuple(map(PeerAddress, addresses)), RULES[peer]),),
        relays_frames=False,
        control_socket=None,
        log=Log("error", "json"),
        warnings=(),
    )


def attitude(number: int) -> bytes:
    """A frame of 40 bytes that differs from that of every other number."""
    codec = mavlink.MAVLink(None, 1, 1)
    codec.seq = number % 256
    return bytes(mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1).pack(codec))


def open_client() -> socket.socket:
    """A client's socket."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


class Pair:
    """The daemons ``left`` and ``right``, and a client of each."""

    def __init__(self, loop: Loop, counting: Counting) -> None:
        self._loop, self._counting = loop, counting
        self._client, self._ground = open_client(), open_client()
        self._number = 0

    async def start(self, paths: int) -> None:
        """Link the daemons. ``paths``: at so many ports of the right one."""
        ground = NetworkUrl(EndpointKind.UDPOUT, Address(*self._ground.getsockname()))
        before = set(self._loop.callbacks)
        self._right = Daemon(config("right", "left", (ANY_PORT,) * paths, ground, ()))
        await self._right.start()
        called = tuple(self._right.parts.peer_sockets.addresses)
        self._at_right = self._new_callbacks(before, {address.port for address in called})
        before = set(self._loop.callbacks)
        self._left = Daemon(config("left", "right", (ANY_PORT,), NetworkUrl(EndpointKind.UDPIN, ANY_PORT), called))
        await self._left.start()
        links = self._left.parts.links["right"], self._right.parts.links["left"]
        await until(lambda: all(link.peer.is_up for link in links))
        own = {address.port for address in self._left.parts.peer_sockets.addresses}
        self._at_left = self._new_callbacks(before, None, own)

    def _new_callbacks(
        self, before: set[int], ports: set[int] | None, others: set[int] | None = None
    ) -> list[tuple[int, Callable[[], object]]]:
        found = []
        for fd, callback in self._loop.callbacks.items():
            if fd in before:
                continue
            port = port_of(fd)
            if port and (ports is None or port in ports) and (others is None or port not in others):
                found.append((port, callback))
        return found

    async def carry(self, frames: int, side: str | None) -> int:
        """Carry frames, and count what one side does. Returns how many arrived."""
        arrived = 0
        ((client_port, at_left),) = self._at_left
        for _ in range(frames):
            self._number += 1
            raw = attitude(self._number)
            self._client.sendto(raw, ("127.0.0.1", client_port))
            self._call(at_left, side == "sending")
            for _, at_right in self._at_right:
                self._call(at_right, side == "receiving" and len(self._at_right) == 1)
            with_frame = b""
            try:
                while with_frame != raw:
                    with_frame = self._ground.recv(2048)
                arrived += 1
            except BlockingIOError:
                pass
            await asyncio.sleep(0.001)
        return arrived

    def _call(self, callback: Callable[[], object], is_counted: bool) -> None:
        if not is_counted:
            callback()
            return
        self._counting.cool()
        self._counting.toggle()
        callback()
        self._counting.toggle()
        self._counting.dump("frame")


def port_of(fd: int) -> int:
    """The local port of a UDP socket; 0 for anything else."""
    try:
        with socket.socket(fileno=socket.dup(fd)) as sock:
            return int(sock.getsockname()[1]) if sock.type == socket.SOCK_DGRAM else 0
    except OSError:
        return 0


async def run(loop: Loop, counting: Counting, frames: int, paths: int) -> dict[str, int]:
    """Count each side."""
    pair = Pair(loop, counting)
    await pair.start(paths)
    await asyncio.sleep(0.2)
    gc.collect()
    counting.begin()
    await pair.carry(WARM_UP, None)
    arrived = {}
    for side in SIDES:
        arrived[side] = await pair.carry(frames, side)
    return arrived


def main() -> None:
    """``pair LIBRARY FRAMES PATHS``: prints how many frames arrived."""
    loop = Loop()
    library, frames, paths = sys.argv[1:]
    gc.disable()
    arrived = loop.run_until_complete(run(loop, Counting(library), int(frames), int(paths)))
    print(json.dumps(arrived), flush=True)


if __name__ == "__main__":
    main()
