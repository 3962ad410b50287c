"""A member of a relay: a node of the core with a UDP socket, in the loop of the test."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from time import monotonic

from tests import waiting
from tests.processes.udp import Sockaddr, open_socket
from tests.waiting import PATIENCE_S
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output, RecordReceived, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.relay_records import RELAYED, Bind, Bound, wrap
from uavlinkd.protocol.settings import Link, PeerSettings

LINK = Link(features=c.FEATURE_RECORDS)


class CoreMember:
    """Keeps a session with the relay. It does not bind by itself. ``certify`` makes the certificate for its key."""

    def __init__(
        self, relay_key: bytes, relay: Sockaddr, certify: Callable[[bytes], bytes] = lambda key: b""
    ) -> None:
        private = os.urandom(c.KEY_BYTES)
        self.key = KeyPair(private).public
        self.node = Node(Secret(private), os.urandom, monotonic())
        self.peer = self.node.add_peer(PeerSettings("relay", relay_key, None, LINK), monotonic())
        self.peer.initiator.certificate = certify(self.key)
        self.path = Path(0, relay)
        self.node.set_paths(self.peer, [self.path], monotonic())
        self.sock = open_socket("127.0.0.1")
        self.bounds: list[Bound] = []
        """What the relay reported, in order."""
        self.data: list[bytes] = []
        """What came along the relay: from the handle on."""
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._loop.add_reader(self.sock, self._on_readable)
        self._on_timer()

    @property
    def address(self) -> Sockaddr:
        """As the relay sees it."""
        host, port = self.sock.getsockname()
        return host, port

    def handles(self, key: bytes) -> list[int]:
        """The handles for a key in the newest report that names it."""
        for bound in reversed(self.bounds):
            if handles := [handle for of, handle in bound.handles if of == key]:
                return handles
        return []

    async def bind(self, *keys: bytes) -> None:
        """Ask the relay, once the path to it works."""
        await self.until(lambda: self.peer.is_up and self.peer.paths.works)
        self.perform(self.node.send_record(self.peer, self.path, Bind(keys), monotonic()))

    async def until_bound(self, key: bytes) -> int:
        """Wait for a handle for a key, and return it."""
        await self.until(lambda: any(self.handles(key)))
        return self.handles(key)[0]

    def send(self, handle: int, datagram: bytes) -> None:
        """Send along the relay."""
        self.sock.sendto(wrap(handle, datagram), self.path.address)

    def send_frames(self, *frames: bytes) -> None:
        """Send frames to the relay itself."""
        self.perform(self.node.send(self.peer, frames, monotonic()))

    async def until(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        """Wait for a condition, which a datagram or a timer of this member fulfils."""
        await waiting.until(condition, timeout_s)

    def perform(self, outputs: list[Output]) -> None:
        """Send what the core wants to send, and keep what came."""
        for output in outputs:
            if isinstance(output, Transmit):
                self.sock.sendto(output.datagram, output.path.address)
            elif isinstance(output, RecordReceived) and isinstance(output.record, Bound):
                self.bounds.append(output.record)

    def close(self) -> None:
        """Leave without a word, as a process does that is killed."""
        if self._timer is not None:
            self._timer.cancel()
        self._loop.remove_reader(self.sock)
        self.sock.close()

    def _on_readable(self) -> None:
        while True:
            try:
                datagram, source = self.sock.recvfrom(65536)
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                continue
            if datagram[:1] == bytes((RELAYED,)):
                self.data.append(datagram[1:])
            else:
                self.perform(self.node.receive(datagram, Path(0, source), monotonic()))
        self._arm()

    def _on_timer(self) -> None:
        self.perform(self.node.handle_timeout(monotonic()))
        self._arm()

    def _arm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        delay_s = max(0.001, min(1.0, self.node.next_deadline() - monotonic()))
        self._timer = self._loop.call_later(delay_s, self._on_timer)
