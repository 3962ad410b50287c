"""The sockets for the peers: those of UDP, and what other kinds of paths add. Peers' names become paths here."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import NetworkConfig, PeerAddress
from uavlinkd.daemon.evidence import REPORTED, Evidence
from uavlinkd.daemon.features import NetworkFacts, PathKind, Reachable, Sender
from uavlinkd.daemon.journal import DaemonJournal, ShellReason
from uavlinkd.daemon.networks import NetworkBudget, Networks, Receive
from uavlinkd.daemon.peer_names import PeerNames
from uavlinkd.daemon.peer_socket import PeerSocket
from uavlinkd.io.ports import failure_name
from uavlinkd.io.reader import PAUSE_S
from uavlinkd.io.resolver import Resolved
from uavlinkd.io.sockets import (
    BindError,
    is_absent,
    is_here,
    send_again,
    udp_socket,
)
from uavlinkd.protocol.constants import IP_BYTES, MAX_ENVELOPE_LIMIT
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.path import Path, SocketAddress, relay_name
from uavlinkd.protocol.path_measures import limit_at
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import run
from uavlinkd.system.stall import StallWatch

_EPHEMERAL = (Address("0.0.0.0", 0), Address("::", 0))
"""Without a listen address the daemon only connects to peers, from any port."""
LOOK_AGAIN_S: Final = 0.1
"""After failed sends, the networks are looked at this often at most."""
_NETWORK_CHANGED: Final = frozenset(
    {
        *(errno.ENODEV, errno.ENXIO, errno.ENETDOWN, errno.ENETUNREACH, errno.EADDRNOTAVAIL),
        *(errno.EHOSTUNREACH, errno.EINVAL),
    }
)
"""Errors of a send that an interface without its address, or a removed one, causes."""

Wrap = Callable[[bytes, Path], tuple[bytes, SocketAddress] | None]
"""Returns what is sent instead of a datagram along a relayed path, and where; None if the handle is gone."""


class PeerSockets:
    """Reads and sends the peers' datagrams. A path's first number is the number of its socket here."""

    def __init__(
        self, stall: StallWatch, drops: DaemonJournal, evidence: Evidence, log: FilteringBoundLogger, node: Node
    ) -> None:
        self.failures: Counter[str] = Counter()
        """Datagrams to peers that the kernel did not accept, by the name of the error."""
        self.without_socket = set[str]()
        """The peers none of whose addresses is of a socket's family."""
        self.networks = Networks((), (), self.put, self.open_sockets, node, log)
        """Those of interfaces and addresses."""
        self.budgets: dict[int, NetworkBudget] = {}
        """Of networks that have one, by the number of the socket."""
        self.senders: list[Sender] = []
        """Send a datagram to an address, by the number of the socket. Relayed paths and budgets are included."""
        self.pause_s = PAUSE_S
        """How long datagrams gather in a busy socket; a relay's do not."""
        self._receive: Receive = lambda *_: None
        self._stall = stall
        self._drops = drops
        self._evidence = evidence
        self._log = log
        self._node = node
        self._slots: list[PeerSocket] = []
        self._kinds: list[PathKind] = []
        self._envelope_limits: dict[int, int] = {}
        self._wrap: Wrap | None = None
        self._is_started = False
        self._checked_at = 0.0
        self._on_change: Callable[[], None] = lambda: None
        self._names: dict[str, PeerNames] = {}

    @property
    def addresses(self) -> list[Address]:
        """The addresses that the sockets are bound to."""
        return [Address(*sock.getsockname()[:2]) for sock in self.open_sockets().values()]

    def open_sockets(self) -> dict[int, socket.socket]:
        """The sockets that are open, by number."""
        return {slot.number: slot.sock for slot in self._slots if slot.sock is not None}

    def interface_of(self, number: int) -> str | None:
        """The network interface that a socket is bound to; None if it uses any."""
        network = self.networks.of_number.get(number)
        return None if network is None else network.config.interface

    def absent_addresses(self) -> list[Address]:
        """The listen addresses that no interface of this machine has now."""
        if self.networks.networks:
            return []
        absent = zip(self.open_sockets().values(), self.addresses, strict=True)
        return [address for sock, address in absent if is_absent(sock)]

    def is_own(self, address: SocketAddress) -> bool:
        """Whether an address leads to one of these sockets."""
        host, port, *rest = address
        return relay_name(address) is None and any(
            sock.getsockname()[1] == port
            and (own.host == host or (own.is_wildcard and is_here(sock.family, (host, 0, *rest))))
            for sock, own in zip(self.open_sockets().values(), self.addresses, strict=True)
            if (sock.family == socket.AF_INET6) == (":" in host)
        )

    def network_name(self, number: int) -> str | None:
        """What people see as the network of a socket; None if the configuration names no networks."""
        network = self.networks.of_number.get(number)
        names = (kind.network_name(number) for kind in self._kinds)
        return next(filter(None, names), None) if network is None else network.config.name

    def way_of(self, path: Path) -> tuple[str | None, SocketAddress | None]:
        """The network of a path, and the relay's address if it is relayed and has a handle."""
        wrapped = None if self._wrap is None else self._wrap(b"", path)
        return self.network_name(path.socket), None if wrapped is None else wrapped[1]

    def absent_networks(self) -> dict[str, str]:
        """The networks that are absent now, each with the reason, and what a person can do."""
        absent = [network for network in self._networks() if not network.presence.hosts]
        return {f"{network.config.name} ({network.presence.reason})": network.remedy for network in absent}

    def network_status(self) -> dict[str, object]:
        """Each network by name, as plain values."""
        return {network.config.name: network.status() for network in self._networks()}

    def _networks(self) -> Iterator[NetworkFacts]:
        yield from self.networks.networks
        for kind in self._kinds:
            yield from kind.networks

    def unresolved(self, name: str) -> set[str]:
        """The host names of a peer that have no address now."""
        return self._names[name].unresolved if name in self._names else set()

    def open(
        self,
        addresses: Sequence[Address],
        networks: Sequence[NetworkConfig] = (),
        kinds: Iterable[PathKind] = (),
    ) -> None:
        """Bind a socket to each address, or ephemeral ones without any; with networks, bind those of each network.

        ``kinds``: those of paths beside UDP.

        Raises:
            BindError: if the daemon cannot listen on an address. The message names the key.
        """
        if networks:
            self.networks = Networks(networks, addresses, self.put, self.open_sockets, self._node, self._log)
            for one in self.networks.sockets.values():
                self._slots.append(PeerSocket(one.number, one.family))
            self.networks.open(monotonic())
        else:
            for number, address in enumerate(addresses or _EPHEMERAL):
                try:
                    sock = udp_socket(address, may_come_later=True)
                except BindError as error:
                    raise BindError(f"listen: {error}") from None
                self._slots.append(PeerSocket(number, sock.family))
                self.put(number, sock)
        for network in self.networks.networks:
            if network.config.budget_bits_s:  # its sockets share it
                budget = NetworkBudget(network.config.budget_bits_s, monotonic())
                self.budgets.update({sock.number: budget for sock in network.sockets})
        for kind in kinds:
            kind.open(self._add_sender)
            self._kinds.append(kind)
        budgets = {number: budget.bits_s for number, budget in self.budgets.items() if budget.bits_s}
        self._node.facts.set_budgets(budgets)
        limits = {number: limit_at(bits_s, IP_BYTES, MAX_ENVELOPE_LIMIT) for number, bits_s in budgets.items()}
        self._node.facts.envelope_limits = limits | self._envelope_limits
        self._choose_senders()

    def _add_sender(
        self, send: Sender, budget: NetworkBudget | None = None, envelope_limit: int | None = None
    ) -> int:
        """Reserve the next socket number for a path of another kind, and return it."""
        number = len(self._slots)
        self._slots.append(PeerSocket(number, send=send))
        if budget is not None:
            self.budgets[number] = budget
        if envelope_limit is not None:
            self._envelope_limits[number] = envelope_limit
        self._choose_senders()
        return number

    def use_relays(self, wrap: Wrap) -> None:
        """Paths may lead along relays from now on."""
        self._wrap = wrap
        self._choose_senders()

    def _choose_senders(self) -> None:
        """A socket without a budget, and without relays, is called directly."""
        self.senders[:] = [
            partial(self._send_charged, slot.number)
            if self._wrap is not None or slot.number in self.budgets
            else slot.send
            for slot in self._slots
        ]

    def put(self, number: int, sock: socket.socket | None) -> None:
        """Use this socket under a number from now on, and close the one before. None: there is no socket."""
        self._slots[number].put(sock)
        self._choose_senders()
        if self._is_started:
            self._read(self._slots[number])

    def start(
        self,
        receive: Receive,
        on_change: Callable[[], None] = lambda: None,
        on_room: Callable[[], None] = lambda: None,
    ) -> None:
        """Start to read. ``on_change`` is called after the core got other paths, or other states of networks.

        ``on_room`` is called when frames that wait may leave.
        """
        self._is_started = True
        self._receive, self._on_change = receive, on_change
        for slot in self._slots:
            self._read(slot)
        for kind in self._kinds:
            kind.start(receive, on_change, on_room)
            for names in self._names.values():
                kind.follow(names.link)
        if self.networks.networks:
            self.check_networks()

    def _read(self, slot: PeerSocket) -> None:
        slot.read(self._receive, partial(self._on_read_error, slot), self._stall, self.pause_s)

    def do_housekeeping(self) -> None:
        """Have the kernel report errors again, and look at the networks. Call it once a second."""
        for slot in self._slots:
            slot.renew_reports()
        self.check_networks()
        for kind in self._kinds:
            run(kind.do_housekeeping)

    def check_networks(self) -> None:
        """Open and close the sockets of the networks that changed, and resolve names again."""
        self._checked_at = now = monotonic()
        if self.networks.check(now):
            for names in self._names.values():
                names.wake()
                self._set_paths(names)
            self._on_change()

    def close(self) -> None:
        """Close the sockets and stop resolving names."""
        for name in list(self._names):
            self.stop_following(name)
        for kind in self._kinds:
            kind.close()
        for slot in self._slots:
            self.put(slot.number, None)

    def send(self, datagram: bytes, path: Path) -> None:
        """Pass a datagram to the kernel. A relay forwards with it: no budget is charged."""
        address = path.address
        if self._wrap is not None and path.is_relayed:
            if (wrapped := self._wrap(datagram, path)) is None:
                self._drops.add("sends_failed", ShellReason.RELAY_HANDLE_GONE, "", 1, monotonic())
                self.failures[ShellReason.RELAY_HANDLE_GONE] += 1
                return
            datagram, address = wrapped
        try:
            self._slots[path.socket].send(datagram, address)
        except OSError as error:
            self.on_send_error(path.socket, datagram, address, error)

    def _send_charged(self, number: int, datagram: bytes, address: SocketAddress) -> None:
        path = Path(number, address)
        if (budget := self.budgets.get(number)) is not None:
            budget.charge(datagram, path, monotonic())
        self.send(datagram, path)

    def on_send_error(self, number: int, datagram: bytes, address: SocketAddress, error: OSError) -> None:
        """A datagram could not be sent. Send it again if the error is about an earlier one; count any other."""
        slot = self._slots[number]
        if slot.sock is None:  # reported as the state of its network
            self.failures[failure_name(error)] += 1
            return
        last = send_again(slot.sock, datagram, address, error, partial(self._take_errors, slot))
        if last is None:
            return
        # Full buffers, no route, a firewall: as if the network had lost it. The core's timers do the rest.
        self._count_failure(last, address)
        is_due = monotonic() - self._checked_at >= LOOK_AGAIN_S
        if self.networks.networks and is_due and last.errno in _NETWORK_CHANGED:
            self._checked_at = monotonic()
            # Not now: the core may be in the middle of its outputs.
            asyncio.get_running_loop().call_soon(self.check_networks)

    def _on_read_error(self, slot: PeerSocket, error: OSError) -> None:
        if not self._take_errors(slot):
            self._count_failure(error, None)

    def _take_errors(self, slot: PeerSocket) -> bool:
        """Note the ICMP errors of earlier datagrams. Returns whether there were any."""
        reports = slot.take_errors()
        for address, code in reports:
            self._evidence.add_error(REPORTED + errno.errorcode.get(code, "OSError"), address, monotonic())
        return bool(reports)

    def _count_failure(self, error: OSError, address: SocketAddress | None) -> None:
        name = failure_name(error)
        self.failures[name] += 1
        self._drops.add("sends_failed", name, "", 1, monotonic())
        self._evidence.add_error(name, address, monotonic())

    def follow(self, link: Reachable) -> None:
        """Resolve the peer's names, and connect to it at their addresses from every socket that may reach them."""
        names = self._names[link.name] = PeerNames(link, self._set_paths, self._log)
        self._set_paths(names)
        if self._is_started:
            for kind in self._kinds:
                kind.follow(link)

    def follow_links(self, links: Iterable[Reachable]) -> None:
        """These are all peers of the daemon from now on."""
        for kind in self._kinds:
            kind.follow_links(links)

    def _set_paths(self, names: PeerNames) -> None:
        link = names.link
        paths = {written: list(self._paths_to(written, resolved)) for written, resolved in names}
        if paths == names.paths:
            return
        names.paths = {**paths}
        if any(paths.values()) or not any(resolved for _, resolved in names):
            self.without_socket.discard(link.name)
        elif link.name not in self.without_socket:
            self.without_socket.add(link.name)
            reason = "no network of its family" if self.networks.networks else "no listen address of its family"
            self._log.warning("peer_unreachable", peer=link.name, reason=reason)
        listed = [path for group in paths.values() for path in group]
        listed.sort(
            key=lambda path: not path.is_web
        )  # the core takes a limited number, and this one must be among them
        link.set_paths(listed, monotonic())
        self.report_absent(monotonic())
        self._on_change()

    def report_absent(self, now: float) -> None:
        """Report the sockets of absent networks to the core. Call it after other paths were set."""
        self.networks.report_absent(now)
        for kind in self._kinds:
            kind.report_state()

    def _paths_to(self, written: PeerAddress, resolved: Resolved) -> Iterator[Path]:
        """The paths to an address of a peer."""
        yield from filter(None, (kind.path_to(written) for kind in self._kinds))
        for family, sockaddr in resolved:
            for number in (slot.number for slot in self._slots if slot.family == family):
                if written.network in ("", self.network_name(number)) and self.networks.may_reach(number, sockaddr):
                    yield Path(number, sockaddr)

    def stop_following(self, name: str) -> None:
        """Stop resolving this peer's names."""
        self.without_socket.discard(name)
        if (names := self._names.pop(name, None)) is not None:
            names.stop()
            for kind in self._kinds:
                kind.unfollow(names.link)
