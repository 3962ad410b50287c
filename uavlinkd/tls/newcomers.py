"""TCP connections that have not said what they want. Each costs a file descriptor, and nothing of TLS or HTTP yet.

Their first bytes stay in the kernel: SO_RCVLOWAT wakes the loop only when the whole ClientHello is there.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from uavlinkd.io.ports import failure_name
from uavlinkd.protocol.path import SocketAddress

NEWCOMERS: Final = 512
"""Newcomers that wait. One more displaces the oldest of the source that has most."""
HELLO_BYTES: Final = 8192
"""A longer ClientHello is refused. A usual one has 500 to 2,000 bytes."""
_HEADER_BYTES: Final = 5
_HANDSHAKE: Final = 22  # the type of a TLS record


@dataclass(slots=True, eq=False)
class Newcomer:
    """A connection, accepted ``since``. ``epoch``: in which its other end could first send."""

    sock: socket.socket
    address: SocketAddress
    source: object
    epoch: int
    since: float
    wanted: int = 0
    """How many bytes must have arrived before the kernel reports them."""


class Newcomers:
    """Those that wait for their first bytes, and in ``ready`` those whose bytes are there, the first one first.

    ``refuse`` counts a newcomer that ends, by reason. ``on_ready``: there is one more in ``ready``.
    """

    def __init__(self, *, is_tls: bool, refuse: Callable[[str], None], on_ready: Callable[[], None]) -> None:
        self.ready: dict[Newcomer, None] = {}
        self._is_tls = is_tls
        self._refuse = refuse
        self._on_ready = on_ready
        self._every: dict[Newcomer, None] = {}  # the oldest first
        self._of_source = Counter[object]()

    def add(self, newcomer: Newcomer) -> None:
        """Wait for its first bytes."""
        if len(self._every) >= NEWCOMERS:
            greediest = max(self._of_source, key=self._of_source.__getitem__)
            self._end(next(one for one in self._every if one.source == greediest), "displaced")
        self._every[newcomer] = None
        self._of_source[newcomer.source] += 1
        newcomer.sock.setblocking(False)
        self._want(newcomer, _HEADER_BYTES if self._is_tls else 1)
        asyncio.get_running_loop().add_reader(newcomer.sock.fileno(), self._look, newcomer)

    def pop(self) -> Newcomer:
        """Remove the first one that is ready."""
        newcomer = next(iter(self.ready))
        self._remove(newcomer)
        self._want(newcomer, 1)
        return newcomer

    def end_since(self, before: float, reason: str) -> None:
        """End those that were accepted before this time."""
        for newcomer in [one for one in self._every if one.since <= before]:
            self._end(newcomer, reason)

    def _look(self, newcomer: Newcomer) -> None:
        try:
            data = newcomer.sock.recv(_HEADER_BYTES + HELLO_BYTES, socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError as error:
            self._end(newcomer, failure_name(error))
            return
        wanted = _wanted(data) if self._is_tls else 1
        if data and wanted > _HEADER_BYTES + HELLO_BYTES:
            self._end(newcomer, "tls")
        elif len(data) >= wanted:
            asyncio.get_running_loop().remove_reader(newcomer.sock.fileno())
            self.ready[newcomer] = None
            self._on_ready()
        elif wanted > newcomer.wanted:
            self._want(newcomer, wanted)
        else:  # the kernel reports fewer only if no more will come
            self._end(newcomer, "closed")

    def _want(self, newcomer: Newcomer, count: int) -> None:
        newcomer.wanted = count
        with suppress(OSError):
            newcomer.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, count)

    def _remove(self, newcomer: Newcomer) -> None:
        del self._every[newcomer]
        self._of_source[newcomer.source] -= 1
        if not self._of_source[newcomer.source]:
            del self._of_source[newcomer.source]
        self.ready.pop(newcomer, None)

    def _end(self, newcomer: Newcomer, reason: str) -> None:
        self._remove(newcomer)
        asyncio.get_running_loop().remove_reader(newcomer.sock.fileno())
        newcomer.sock.close()
        self._refuse(reason)


def _wanted(data: bytes) -> int:
    """The length of the TLS record that begins so; more than any if it is not one of a handshake."""
    if data[:1] != bytes((_HANDSHAKE,)):
        return 1 << 16
    return max(_HEADER_BYTES + int.from_bytes(data[3:_HEADER_BYTES]), _HEADER_BYTES)
