"""The networks of this machine: which of them are there now, and the sockets bound to them.

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
from collections.abc import Iterable, Sequence
from typing import Final, Protocol

from structlog.typing import FilteringBoundLogger

from uavlinkd.config import NetworkConfig
from uavlinkd.core.path import SocketAddress
from uavlinkd.endpoints.presence import LINK_LOCAL, Presence, family_of, look
from uavlinkd.endpoints.sockets import BindError, network_socket
from uavlinkd.link.conditions import LineLimits
from uavlinkd.link.network_log import NetworkLog
from uavlinkd.system.addresses import Address

BRING_UP: Final = (
    "plug the modem in, or bring the interface up (`ip -brief address`): the daemon uses it within a second"
)
_WILDCARDS: Final = {socket.AF_INET: "0.0.0.0", socket.AF_INET6: "::"}


class SocketStates(Protocol):
    """The part of :class:`uavlinkd.core.node.Node` that networks report to."""

    def set_socket_state(self, socket: int, now: float, *, is_up: bool) -> None:
        """The network behind a socket disappeared; or it appeared or changed its address."""

    def set_metered(self, sockets: Iterable[int], now: float) -> None:
        """The numbers of the sockets whose network is metered."""


class NetworkSocket:
    """The socket of one network and one address family, open or not."""

    __slots__ = ("family", "hosts", "index", "is_fixed", "number", "port")

    def __init__(self, number: int, family: socket.AddressFamily, port: int) -> None:
        self.number = number
        self.family = family
        self.port = port
        """The port to open it with: that of ``listen``, else the one that it had before; 0: any."""
        self.is_fixed = bool(port)
        self.index: int | None = None
        """The interface's number when it was opened; None while it is closed."""
        self.hosts: tuple[str, ...] = ()
        """The addresses of its network and family, while it is open."""


class Network:
    """One ``[[network]]``: its sockets, and what the machine had of it when it was last looked at."""

    def __init__(self, config: NetworkConfig, sockets: Sequence[NetworkSocket], log: NetworkLog) -> None:
        self.config = config
        self.sockets = sockets
        self.presence = Presence()
        self.log = log

    @property
    def name(self) -> str:
        """Its name in the configuration."""
        return self.config.name

    @property
    def is_present(self) -> bool:
        """Whether one of its sockets is open."""
        return any(one.index is not None for one in self.sockets)


class SocketHolder(Protocol):
    """Holds the sockets by number."""

    def put(self, number: int, sock: socket.socket | None) -> None:
        """Use this socket from now on, and close the one before. None: there is no socket."""

    def open_sockets(self) -> list[socket.socket]:
        """All that are open."""


class Networks:
    """All networks of the configuration. ``listen`` has the ports of their sockets."""

    def __init__(
        self,
        configs: Iterable[NetworkConfig],
        listen: Iterable[Address],
        holder: SocketHolder,
        states: SocketStates,
        log: FilteringBoundLogger,
    ) -> None:
        ports = {address.family: address.port for address in listen}
        self.networks: list[Network] = []
        self._of_socket: dict[int, tuple[Network, NetworkSocket]] = {}
        self._holder = holder
        self._states = states
        limits = LineLimits()
        for config in configs:
            sockets = [
                NetworkSocket(len(self._of_socket) + place, family, ports.get(family, 0))
                for place, family in enumerate(config.families)
            ]
            network = Network(config, sockets, NetworkLog(config.name, limits, log))
            self.networks.append(network)
            self._of_socket.update({one.number: (network, one) for one in sockets})

    @property
    def families(self) -> list[socket.AddressFamily]:
        """The address family of each socket, by number."""
        return [one.family for _, one in self._of_socket.values()]

    def network_of(self, number: int) -> Network:
        """The network of a socket."""
        return self._of_socket[number][0]

    def may_reach(self, number: int, address: SocketAddress) -> bool:
        """Whether a socket can send to an address of its family, as far as its own addresses show.

        While a network is absent, the answer is yes: it may have any address when it appears.
        """
        one = self._of_socket[number][1]
        if one.index is None or one.family == socket.AF_INET:
            return True
        if address[0].startswith(LINK_LOCAL):
            return one.index in (0, address[-1])
        return not all(host.startswith(LINK_LOCAL) for host in one.hosts)

    def open(self, now: float) -> None:
        """Open the sockets of the networks that are there. Call it once.

        Raises:
            BindError: a network is there, and its socket cannot be opened. The message names the network.
        """
        metered = [one.number for network, one in self._of_socket.values() if network.config.metered]
        self._states.set_metered(metered, now)
        for network in self.networks:
            network.presence = look(network.config.interface, network.config.address)
            for one in network.sockets:
                try:
                    self._follow(network, one, now)
                except BindError as error:
                    raise BindError(f"network ({network.name}): {error}") from None

    def check(self, now: float) -> bool:
        """Look at all networks, and open and close sockets. Returns whether anything changed."""
        has_changed = False
        for network in self.networks:
            network.presence = look(network.config.interface, network.config.address)
            for one in network.sockets:
                try:
                    has_changed |= self._follow(network, one, now)
                except BindError as error:  # it is tried again at the next call
                    if not network.is_present:
                        network.presence = Presence(reason=str(error))
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
                self._holder.put(one.number, None)
                self._states.set_socket_state(one.number, now, is_up=False)
            if index is not None:
                self._open(network.config, one)
        one.index, one.hosts = index, hosts
        if index is not None:
            self._states.set_socket_state(one.number, now, is_up=True)
        return True

    def report_absent(self, now: float) -> None:
        """Report the sockets that are closed. Call it after other paths were set: the core knows states by path."""
        for _, one in self._of_socket.values():
            if one.index is None:
                self._states.set_socket_state(one.number, now, is_up=False)

    def _open(self, config: NetworkConfig, one: NetworkSocket) -> None:
        host = config.address or _WILDCARDS[one.family]
        others = self._holder.open_sockets()
        try:
            sock = network_socket(Address(host, one.port), config.interface, others)
        except BindError as error:
            if one.is_fixed or not error.is_taken:
                raise
            sock = network_socket(Address(host, 0), config.interface, others)
        one.port = sock.getsockname()[1]
        self._holder.put(one.number, sock)

    def absent(self) -> dict[str, str]:
        """The networks that are absent now, each with the reason, and what a person can do."""
        return {
            f"{network.name} ({network.presence.reason})": BRING_UP
            for network in self.networks
            if not network.is_present
        }

    def status(self) -> dict[str, object]:
        """Each network by name, as plain values."""
        return {
            network.name: {
                "interface": network.config.interface,
                "address": network.config.address,
                "is_metered": network.config.metered,
                "budget_bits_s": network.config.budget_bits_s,
                "is_present": network.is_present,
                "absent_because": network.presence.reason or None,
                "addresses": list(network.presence.hosts),
                "ports": [one.port for one in network.sockets if one.index is not None],
                "serial": None,
            }
            for network in self.networks
        }
