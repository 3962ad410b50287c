"""The UDP sockets towards the peers, and the way from a peer's names to paths along them."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from structlog.typing import FilteringBoundLogger

from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.core.outputs import Path
from uavlinkd.endpoints.ports import failure_name
from uavlinkd.endpoints.sockets import BindError, Reader, numeric_host, udp_socket
from uavlinkd.ops.log import DropSummary
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.system.resolver import Resolved, keep_resolving
from uavlinkd.system.stall import StallWatch
from uavlinkd.system.tasks import keep_running

_EPHEMERAL = (Address("0.0.0.0", 0), Address("::", 0))
"""Without a listen address the daemon only calls, from any port."""

Arrived = Sequence[tuple[bytes, Path]]
"""Datagrams, each with the path that it came along."""


class PeerSockets:
    """Reads and sends the peers' datagrams. A path's first number is the place of its socket here.

    ``on_arrived`` gets what came in one wake-up, with the monotonic time and the epoch of it.
    """

    def __init__(
        self,
        on_arrived: Callable[[Arrived, float, int], None],
        stall: StallWatch,
        drops: DropSummary,
        log: FilteringBoundLogger,
    ) -> None:
        self.failures: Counter[str] = Counter()
        """What the kernel did not take towards the peers, by the name of the error."""
        self._on_arrived = on_arrived
        self._stall = stall
        self._drops = drops
        self._log = log
        self._sockets: list[socket.socket] = []
        self._following: dict[str, asyncio.Task[None]] = {}

    @property
    def addresses(self) -> list[Address]:
        """Where the sockets are bound."""
        return [Address(*each.getsockname()[:2]) for each in self._sockets]

    def open(self, addresses: Sequence[Address]) -> None:
        """Bind a socket to each address, or ephemeral ones without any.

        Raises:
            BindError: where an address cannot be listened on, with the key that says so.
        """
        for address in addresses or _EPHEMERAL:
            try:
                self._sockets.append(udp_socket(address, may_come_later=True))
            except BindError as error:
                raise BindError(f"listen: {error}") from None

    def start(self) -> None:
        """Read whenever something is there."""
        loop = asyncio.get_running_loop()
        for number, sock in enumerate(self._sockets):
            loop.add_reader(sock, self._on_readable, number, Reader(sock, self._count_failure, self._stall))

    def close(self) -> None:
        """Close the sockets, and follow no name any more."""
        for name in list(self._following):
            self.stop_following(name)
        loop = asyncio.get_running_loop()
        for sock in self._sockets:
            loop.remove_reader(sock)
            sock.close()

    def _on_readable(self, number: int, reader: Reader) -> None:
        arrived, now, epoch = reader.read()
        self._on_arrived([(datagram, _path(number, source)) for datagram, source in arrived], now, epoch)

    def send(self, datagram: bytes, path: Path) -> None:
        """Hand a datagram to the kernel."""
        number, host, port = path
        try:
            self._sockets[number].sendto(datagram, (host, port))
        except OSError as error:
            # Full buffers, no route, a firewall: as if the network had lost it, and the timers see to the rest.
            self._count_failure(error)

    def _count_failure(self, error: OSError) -> None:
        name = failure_name(error)
        self.failures[name] += 1
        self._drops.add("sends_failed", name, "", 1, monotonic())

    def follow(self, link: PeerLink, on_found: Callable[[], None]) -> None:
        """Call the peer where its names point now, from every socket of the right family.

        ``on_found`` is told each time that they point elsewhere.
        """
        if not link.config.addresses:
            link.set_paths((), monotonic())
            return

        def on_resolved(found: Resolved) -> bool:
            paths: list[Path] = [
                (number, host, port)
                for family, host, port in found
                for number, sock in enumerate(self._sockets)
                if sock.family == family
            ]
            if not paths:
                self._log.warning("peer_unreachable", peer=link.name, reason="no listen address of its family")
            link.set_paths(paths, monotonic())
            on_found()
            return True

        work = keep_resolving(link.config.addresses, lambda: not link.peer.is_up, on_resolved, self._log)
        self._following[link.name] = keep_running(work, f"the search for {link.name}")

    def stop_following(self, name: str) -> None:
        """Look this peer's names up no more."""
        task = self._following.pop(name, None)
        if task is not None:
            task.cancel()


def _path(number: int, source: tuple[Any, ...]) -> Path:
    return (number, *source) if len(source) == 2 else (number, numeric_host(source), source[1])
