"""The UDP sockets for the peers, and the resolution of a peer's names to paths."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

from structlog.typing import FilteringBoundLogger

from uavlinkd.core.path import Path, SocketAddress
from uavlinkd.endpoints.error_queue import ErrorReports, send_again
from uavlinkd.endpoints.ports import failure_name
from uavlinkd.endpoints.reader import Datagrams, Reader
from uavlinkd.endpoints.sockets import BindError, is_absent, is_here, udp_socket
from uavlinkd.link.drop_summary import DropSummary
from uavlinkd.link.evidence import Evidence
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.resolver import Resolved, keep_resolving
from uavlinkd.system.stall import StallWatch
from uavlinkd.system.tasks import keep_running

_EPHEMERAL = (Address("0.0.0.0", 0), Address("::", 0))
"""Without a listen address the daemon only connects to peers, from any port."""


class Receive(Protocol):
    """Receives the datagrams of one read."""

    def __call__(self, socket: int, datagrams: Datagrams, now: float, epoch: int, waited_s: float, /) -> None:
        """``socket`` is the number of the socket. The rest is as in :class:`uavlinkd.endpoints.reader.Deliver`."""


class PeerSockets:
    """Reads and sends the peers' datagrams. A path's first number is the place of its socket here."""

    def __init__(
        self,
        receive: Receive,
        stall: StallWatch,
        drops: DropSummary,
        evidence: Evidence,
        log: FilteringBoundLogger,
    ) -> None:
        self.failures: Counter[str] = Counter()
        """Datagrams to peers that the kernel did not accept, by the name of the error."""
        self.unresolved: dict[str, set[str]] = {}
        """The host names that have no address now, by peer."""
        self.without_socket: set[str] = set()
        """The peers none of whose addresses is of a listen address's family."""
        self._receive = receive
        self._stall = stall
        self._drops = drops
        self._evidence = evidence
        self._log = log
        self._sockets: list[socket.socket] = []
        self._readers: list[Reader] = []
        self._reports: list[ErrorReports] = []
        self._following: dict[str, asyncio.Task[None]] = {}

    @property
    def addresses(self) -> list[Address]:
        """The addresses that the sockets are bound to."""
        return [Address(*sock.getsockname()[:2]) for sock in self._sockets]

    def absent_addresses(self) -> list[Address]:
        """The listen addresses that no interface of this machine has now."""
        absent = zip(self._sockets, self.addresses, strict=True)
        return [address for sock, address in absent if is_absent(sock)]

    def is_own(self, address: SocketAddress) -> bool:
        """Whether an address leads to one of these sockets."""
        host, port, *rest = address
        return any(
            sock.getsockname()[1] == port
            and (own.host == host or (own.is_wildcard and is_here(sock.family, (host, 0, *rest))))
            for sock, own in zip(self._sockets, self.addresses, strict=True)
            if (sock.family == socket.AF_INET6) == (":" in host)
        )

    def open(self, addresses: Sequence[Address]) -> None:
        """Bind a socket to each address, or ephemeral ones without any.

        Raises:
            BindError: if the daemon cannot listen on an address. The message names the key.
        """
        for address in addresses or _EPHEMERAL:
            try:
                self._sockets.append(udp_socket(address, may_come_later=True))
            except BindError as error:
                raise BindError(f"listen: {error}") from None

    def start(self) -> None:
        """Start to read."""
        for number, sock in enumerate(self._sockets):
            on_failure = partial(self._on_read_error, number)
            reader = Reader(sock, partial(self._receive, number), on_failure, self._stall)
            reader.start()
            self._readers.append(reader)
            self._reports.append(ErrorReports(sock))

    def do_housekeeping(self) -> None:
        """Have the kernel report errors again. Call it once a second."""
        for reports in self._reports:
            reports.renew()

    def close(self) -> None:
        """Close the sockets and stop resolving names."""
        for name in list(self._following):
            self.stop_following(name)
        for reader in self._readers:
            reader.stop()
        for sock in self._sockets:
            sock.close()

    def send(self, datagram: bytes, path: Path) -> None:
        """Pass a datagram to the kernel."""
        number, address = path
        try:
            self._sockets[number].sendto(datagram, address)
        except OSError as error:
            sock, take_errors = self._sockets[number], partial(self._take_errors, number)
            last = send_again(sock, datagram, address, error, take_errors)
            if last is not None:
                # Full buffers, no route, a firewall: as if the network had lost it. The core's timers do the rest.
                self._count_failure(last, address)

    def _on_read_error(self, number: int, error: OSError) -> None:
        if not self._take_errors(number):
            self._count_failure(error, None)

    def _take_errors(self, number: int) -> bool:
        """Note the ICMP errors of earlier datagrams. Returns whether there were any."""
        if not self._reports:  # not started
            return False
        reports = self._reports[number].take()
        for address, code in reports:
            self._evidence.add_report(code, address, monotonic())
        self._readers[number].renew()
        return bool(reports)

    def _count_failure(self, error: OSError, address: SocketAddress | None) -> None:
        name = failure_name(error)
        self.failures[name] += 1
        self._drops.add("sends_failed", name, "", 1, monotonic())
        self._evidence.add_failure(name, address, monotonic())

    def follow(self, link: PeerLink, on_resolved: Callable[[], None]) -> None:
        """Resolve the peer's names, and connect to it at their addresses from every socket of the same family.

        ``on_resolved`` is called after each change of the addresses.
        """
        if not link.config.addresses:
            link.set_paths((), monotonic())
            return

        def set_paths(addresses: Resolved) -> bool:
            paths = [
                Path(number, sockaddr)
                for family, sockaddr in addresses
                for number, sock in enumerate(self._sockets)
                if sock.family == family
            ]
            self.without_socket.discard(link.name)
            if not paths:
                self.without_socket.add(link.name)
                self._log.warning("peer_unreachable", peer=link.name, reason="no listen address of its family")
            link.set_paths(paths, monotonic())
            on_resolved()
            return True

        unresolved = self.unresolved[link.name] = set[str]()
        work = keep_resolving(link.config.addresses, lambda: not link.peer.is_up, set_paths, self._log, unresolved)
        self._following[link.name] = keep_running(work, f"the search for {link.name}")

    def stop_following(self, name: str) -> None:
        """Stop resolving this peer's names."""
        self.unresolved.pop(name, None)
        self.without_socket.discard(name)
        task = self._following.pop(name, None)
        if task is not None:
            task.cancel()
