"""The networks of this machine: which of them are there now, the sockets bound to them, and their budgets.

A network may be absent at start, appear, disappear, and change its addresses or the number of its interface. Then the
daemon opens or closes the sockets of that network. The others are not touched. A socket keeps its number.

The daemon looks once a second, and at once after a failed send, so it notices a lost network with the next datagram.
That is soon enough for a network that is back: a path needs three answers in 2 s before it is used again. Netlink
would report both at once, but it needs a library, and a permission that the service's sandbox does not give.

An interface that is up without a carrier counts as present: some drivers report the carrier wrongly, and the probes
of the paths detect a dead radio.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import NetworkConfig
from uavlinkd.io.reader import Datagrams
from uavlinkd.io.sockets import LINK_LOCAL, BindError, Presence, family_of, look, network_socket
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.ops.line_limits import LineLimits
from uavlinkd.protocol.constants import LINE_BYTES, RELAY_BYTES
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.path import Path, SocketAddress
from uavlinkd.system.addresses import IPV4_UDP_BYTES, IPV6_UDP_BYTES, Address

COPIES_SHARE: Final = 0.5
"""The part of a budget that copies may use. The rest is for what only this network carries."""
WEB_BYTES: Final = 82
"""Of a message by TLS over IPv4: headers of IP and TCP (with timestamps), TLS record, and WebSocket frame."""
LARGEST_BYTES: Final = 400
"""A bucket holds a largest frame in an envelope, with IP and UDP header."""
RATE_CHANGE: Final = 0.25
"""The core gets a rate that differs by more than this share from the last one that it got."""
LEAST_CORE_SHARE: Final = 0.25
"""The core gets this part of the budget at least: a peer that is lost must not wait minutes for the next try."""
_WILDCARDS: Final = {socket.AF_INET: "0.0.0.0", socket.AF_INET6: "::"}


Receive = Callable[[int, Datagrams, float, int, float], None]
"""Receives the datagrams of one read: the number of the socket, and the rest as
:data:`uavlinkd.io.reader.DatagramHandler`."""


def carrier_bytes(path: Path) -> int:
    """What a network adds to each datagram: headers of IP and UDP, or the framing on a line.

    On a relayed path also what the relay adds. Its own address is not in the path: the longer header counts.
    """
    if path.is_serial:
        return LINE_BYTES
    if path.is_web:
        return WEB_BYTES
    if path.is_relayed:
        return RELAY_BYTES + IPV6_UDP_BYTES
    return IPV6_UDP_BYTES if ":" in path.host else IPV4_UDP_BYTES


def wire_bytes(datagram: bytes, path: Path) -> int:
    """The bytes of a datagram with what its network adds: IP and UDP header, or the framing on a line."""
    return len(datagram) + carrier_bytes(path)


class NetworkBudget:
    """The budget of one network, and the part of it that copies may use. All peers share both."""

    __slots__ = ("all", "bits_s", "copies", "core_bits_s")

    def __init__(self, budget_bits_s: int, now: float, least_burst: int = LARGEST_BYTES) -> None:
        self.bits_s = budget_bits_s
        self.core_bits_s: float = budget_bits_s
        """The rate that the core has."""
        self.all = Bucket(budget_bits_s, now, least_burst)
        self.copies = Bucket(COPIES_SHARE * budget_bits_s, now, least_burst)

    def set_rate(self, bits_s: float, now: float) -> None:
        """Use another budget from now on."""
        self.all.set_rate(bits_s / 8, now)
        self.copies.set_rate(COPIES_SHARE * bits_s / 8, now)

    def update_core(self, bits_s: float) -> bool:
        """Choose the rate for the core. Returns whether it has changed."""
        rate = max(bits_s, LEAST_CORE_SHARE * self.bits_s)
        is_full_again = rate == self.bits_s != self.core_bits_s
        if not is_full_again and abs(rate - self.core_bits_s) <= RATE_CHANGE * self.core_bits_s:
            return False
        self.core_bits_s = rate
        return True

    def charge(self, datagram: bytes, path: Path, now: float) -> None:
        """Charge a datagram that is sent: an envelope, a handshake message, a probe or any other."""
        self.all.spend(wire_bytes(datagram, path), now)


class NetworkLog:
    """Writes a line about one network when what the machine has of it changes."""

    __slots__ = ("_limits", "_log", "_name", "written")

    def __init__(self, name: str, limits: LineLimits, log: FilteringBoundLogger) -> None:
        self.written: Presence | None = None
        """What the log says about it."""
        self._name = name
        self._limits = limits
        self._log = log.bind(network=name)

    def note(self, presence: Presence, now: float) -> None:
        """Write what changed since the last line. If there were too many lines, the next call tries again."""
        before = self.written
        if presence == before:
            return
        if before is not None and not presence.hosts and not before.hosts:  # another reason of absence: no line
            self.written = presence
            return
        omitted = self._limits.take("network", self._name, now)
        if omitted is None:
            return
        self.written = presence
        if presence.hosts:
            event = "network_changed" if before is not None and before.hosts else "network_appeared"
            self._log.info(event, addresses=list(presence.hosts), interface_index=presence.ifindex, **omitted)
        else:
            event = "network_not_here_yet" if before is None else "network_disappeared"
            self._log.warning(event, reason=presence.reason, **omitted)


def network_status(
    config: NetworkConfig, presence: Presence, ports: Sequence[int], serial: dict[str, object] | None = None
) -> dict[str, object]:
    """A network as plain values. ``serial``: what only a serial network has."""
    return {
        "interface": config.interface,
        "address": config.address,
        "is_metered": config.metered,
        "budget_bits_s": config.budget_bits_s,
        "is_present": bool(presence.hosts),
        "absent_because": presence.reason or None,
        "addresses": list(presence.hosts),
        "ports": list(ports),
        "serial": serial,
    }


@dataclass(slots=True, eq=False)
class NetworkSocket:
    """The socket of one network and one address family, open or not."""

    number: int
    family: socket.AddressFamily
    listen_port: int
    """That of ``listen``; 0: any."""
    port: int = 0
    """The one that it had before."""
    index: int | None = None
    """The interface's number when it was opened; None while it is closed."""
    hosts: tuple[str, ...] = ()
    """The addresses of its network and family, while it is open."""


@dataclass(slots=True, eq=False)
class Network:
    """One ``[[network]]``: its sockets, and what the machine had of it when it was last looked at."""

    config: NetworkConfig
    sockets: Sequence[NetworkSocket]
    log: NetworkLog
    presence: Presence = field(default_factory=Presence)
    remedy: str = (
        "plug the modem in, or bring the interface up (`ip -brief address`): the daemon uses it within a second"
    )
    """What a person can do while it is absent."""

    def status(self) -> dict[str, object]:
        """As plain values."""
        ports = [one.port for one in self.sockets if one.index is not None]
        return network_status(self.config, self.presence, ports)


class Networks:
    """All networks of the configuration. ``listen`` has the ports of their sockets.

    ``put`` has a socket used by its number from now on (None: no socket), and ``opened`` returns all that are open.
    """

    def __init__(
        self,
        configs: Iterable[NetworkConfig],
        listen: Iterable[Address],
        put: Callable[[int, socket.socket | None], None],
        opened: Callable[[], Mapping[int, socket.socket]],
        states: Node,
        log: FilteringBoundLogger,
    ) -> None:
        ports = {address.family: address.port for address in listen}
        self.networks: list[Network] = []
        self.of_number: dict[int, Network] = {}
        """The network of each socket."""
        self.sockets: dict[int, NetworkSocket] = {}
        """By number."""
        self._put, self._opened = put, opened
        self._states = states
        limits = LineLimits()
        for config in configs:
            numbered = enumerate(config.families, len(self.of_number))
            sockets = [NetworkSocket(number, family, ports.get(family, 0)) for number, family in numbered]
            network = Network(config, sockets, NetworkLog(config.name, limits, log))
            self.networks.append(network)
            for one in sockets:
                self.of_number[one.number], self.sockets[one.number] = network, one

    def may_reach(self, number: int, address: SocketAddress) -> bool:
        """Whether a socket can send to an address of its family, as far as its own addresses show.

        While a network is absent, the answer is yes: it may have any address when it appears.
        """
        one = self.sockets.get(number)
        if one is None or one.index is None or one.family == socket.AF_INET:
            return True
        if address[0].startswith(LINK_LOCAL):
            return one.index in (0, address[-1])
        return not all(host.startswith(LINK_LOCAL) for host in one.hosts)

    def open(self, now: float) -> None:
        """Open the sockets of the networks that are there. Call it once.

        Raises:
            BindError: a network is there, and its socket cannot be opened. The message names the network.
        """
        metered = [number for number, network in self.of_number.items() if network.config.metered]
        self._states.set_metered(metered, now)
        self.check(now, is_start=True)

    def check(self, now: float, *, is_start: bool = False) -> bool:
        """Look at all networks, and open and close sockets. Returns whether anything changed."""
        has_changed = False
        for network in self.networks:
            network.presence = look(network.config.interface, network.config.address)
            for one in network.sockets:
                try:
                    has_changed |= self._follow(network, one, now)
                except BindError as error:  # it is tried again at the next call
                    if is_start:
                        raise BindError(f"network ({network.config.name}): {error}") from None
                    if all(other.index is None for other in network.sockets):
                        network.presence = Presence(reason=str(error))
            if not is_start:
                network.log.note(network.presence, now)
        return has_changed

    def _follow(self, network: Network, one: NetworkSocket, now: float) -> bool:
        """Open or close one socket if its network appeared, disappeared or changed. Returns whether it did."""
        hosts = tuple(host for host in network.presence.hosts if family_of(host) == one.family)
        index = network.presence.ifindex if hosts else None
        if (index, hosts) == (one.index, one.hosts):
            return False
        if index != one.index:
            if one.index is not None:
                one.index, one.hosts = None, ()
                self._put(one.number, None)
                self._states.set_socket_state(one.number, now, is_up=False)
            if index is not None:
                self._open(network.config, one)
        one.index, one.hosts = index, hosts
        if index is not None:
            self._states.set_socket_state(one.number, now, is_up=True)
        return True

    def report_absent(self, now: float) -> None:
        """Report the sockets that are closed. Call it after other paths were set: the core knows states by path."""
        for one in self.sockets.values():
            if one.index is None:
                self._states.set_socket_state(one.number, now, is_up=False)

    def _open(self, config: NetworkConfig, one: NetworkSocket) -> None:
        host = config.address or _WILDCARDS[one.family]
        others = self._opened().values()
        try:
            sock = network_socket(Address(host, one.listen_port or one.port), config.interface, others)
        except BindError as error:
            if one.listen_port or not error.is_taken:
                raise
            sock = network_socket(Address(host, 0), config.interface, others)
        one.port = sock.getsockname()[1]
        self._put(one.number, sock)
