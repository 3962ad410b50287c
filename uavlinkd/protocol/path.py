"""A path to a peer, as the shell names it, and facts about the networks behind the sockets."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.suites import Suite

SocketAddress = tuple[str, int] | tuple[str, int, int, int] | tuple[str, int, str] | tuple[str, int, int, int, str]
"""An Internet address as the kernel takes and gives it: host and port; for IPv6 also flow label and interface.

A last text is the own address that was asked, if the kernel would answer from another one: that is another path.
"""

SERIAL_HOST = "serial"
"""The host of the only path along a serial network: ``Path(socket, (SERIAL_HOST, 0))``."""

WEB_HOST = "wss://"
"""How the host of the only path along a connection by TLS to a relay begins: ``Path(socket, (URL, 0))``. At the relay
such a path has the address of its TCP connection."""


RELAY_HOST = "relay "
"""How the host of a relayed path begins; the relay's name follows. See :func:`relayed`."""


class Path(NamedTuple):
    """A local socket and a peer's address there. The core compares paths, and sends along those that it was given."""

    socket: int
    """The shell's number of the socket."""
    address: SocketAddress

    @property
    def host(self) -> str:
        """The numeric host."""
        return self.address[0]

    @property
    def is_serial(self) -> bool:
        """Whether it is a line, which has no addresses."""
        return self.address[0] == SERIAL_HOST

    @property
    def is_udp(self) -> bool:
        """Whether it has the address of a socket."""
        return not (self.is_serial or self.is_relayed or self.is_web)

    @property
    def is_web(self) -> bool:
        """Whether it is a connection by TLS to a relay."""
        return self.address[0].startswith(WEB_HOST)

    @property
    def is_relayed(self) -> bool:
        """Whether it leads through a relay."""
        return self.address[0].startswith(RELAY_HOST)

    @property
    def sender(self) -> SocketAddress | str:
        """What has budgets of its own: a place, or a relay with all its handles."""
        return self.host if self.is_relayed else self.place

    @property
    def place(self) -> SocketAddress:
        """Where the peer is, whichever socket and own address reach it. Each line is a place of its own."""
        return (SERIAL_HOST, self.socket) if self.is_serial else remote_of(self.address)


def remote_of(address: SocketAddress) -> SocketAddress:
    """An address without the own address that was asked."""
    return address[:-1] if isinstance(address[-1], str) else address


def relayed(socket: int, relay: str, handle: int) -> Path:
    """The path along a relay, by its name here, with a handle that it assigned on this socket."""
    return Path(socket, (RELAY_HOST + relay, handle))


def relay_name(address: SocketAddress) -> str | None:
    """The relay through which an address of a path leads; None if it is direct."""
    host = address[0]
    return host.removeprefix(RELAY_HOST) if host.startswith(RELAY_HOST) else None


class Pace(NamedTuple):
    """How often a peer is asked for an echo, and how long the answer may take. It depends on the best path."""

    interval_s: float = 0.0
    """Between periodic requests, at least."""
    hold_s: float = c.HOLD_S
    """How long frames wait for the peer's proof that they are new, and how old that proof may be."""
    ask_s: float = c.HOLD_ASK_S
    """Between requests meanwhile."""


FREE = Pace()
"""Of a network without a budget."""


class SocketFacts:
    """The facts about each socket. ``metered``: those whose network is paid by the byte, and all ``streams``.

    ``streams``: those whose datagrams travel in TCP connections, which deliver late what UDP would lose.
    """

    __slots__ = ("_budgets", "_rates", "envelope_limits", "metered", "peer_at", "peers", "streams")

    def __init__(self, metered: Iterable[int] = ()) -> None:
        self.metered = set(metered)
        self.streams = set[int]()
        self._budgets: dict[int, float] = {}
        self._rates: dict[int, float] = {}
        self.peers = 0
        """So many use each network."""
        self.envelope_limits: dict[int, int] = {}
        """The longest envelopes that several frames share, in bytes: :func:`.path_measures.limit_at`."""
        self.peer_at: dict[int, Hashable | None] = {}
        """The peer at the other end of each point-to-point network; None during a change."""

    def add_stream(self, socket: int) -> None:
        """The datagrams of this socket travel in TCP connections. Call it before there is a path along it."""
        self.streams.add(socket)
        self.metered.add(socket)

    # Budgets.

    def set_budgets(self, budgets: Mapping[int, float]) -> None:
        """The bits a second that the networks of these sockets carry, of all peers together."""
        self._budgets = dict(budgets)
        self._rates = dict(budgets)

    def set_rates(self, rates: Mapping[int, float]) -> None:
        """In bits a second, of networks with a budget that carry less at present."""
        self._rates = {**self._budgets, **rates}

    def least_probe_s(self, path: Path) -> float:
        """Between questions along a path: every peer may be probed, and sends as many probes as it gets."""
        return self._share_s(path, c.PROBE_BYTES, c.PROBE_BUDGET_SHARE, self._rates)

    def try_interval_s(self, path: Path, suite: Suite, added: int = 0) -> float:
        """Between two initiations along a path, longer by ``added`` bytes; 0 without a budget."""
        size = wire.initiation_bytes(suite) + added + wire.response_bytes(suite)
        return c.TRY_AIRTIMES * self._airtime_s(path, size, self._rates)

    def pace(self, path: Path) -> Pace:
        """That of a peer whose best path this is.

        By the budget, not by the rate: an attacker that delays answers lowers the rate, and must not make the peer
        accept older frames by that.
        """
        airtime_s = self._airtime_s(path, c.ECHO_BYTES, self._budgets)
        if not airtime_s:
            return FREE
        return Pace(
            self._share_s(path, c.ECHO_BYTES, c.ECHO_BUDGET_SHARE, self._budgets),
            min(max(c.HOLD_S, c.HOLD_AIRTIMES * airtime_s), c.LATE_AFTER_S),
            max(c.HOLD_ASK_S, self.repeat_s(path, 0)),
        )

    def repeat_s(self, path: Path, more_bytes: int) -> float:
        """Between repetitions of a message so much longer than an echo request, at least; 0 without a budget."""
        return c.ASK_AIRTIMES * self._airtime_s(path, c.ECHO_BYTES + more_bytes, self._budgets)

    def _airtime_s(self, path: Path, size: int, rates: Mapping[int, float]) -> float:
        """How long a datagram and its answer, with so many bytes together, take; 0 on a network without a budget."""
        rate = rates.get(path.socket)
        carriers = 2 * (c.LINE_BYTES if path.is_serial else c.IP_BYTES)
        return 0.0 if rate is None else 8 * (size + carriers) / rate

    def _share_s(self, path: Path, size: int, share: float, rates: Mapping[int, float]) -> float:
        peers = 1 if path.socket in self.peer_at else self.peers
        return peers * self._airtime_s(path, size, rates) / share

    # Point-to-point networks.

    def set_point_to_point(self, peers: Mapping[int, Hashable | None]) -> None:
        """The peers at the other end of these sockets, if there is one.

        Datagrams of other peers that arrive there are dropped, as ``wrong_network``. Other sockets may have any peer.
        """
        self.peer_at = dict(peers)

    def check_network(self, peer: Hashable, path: Path) -> None:
        """A datagram that names this peer, or is of it, came along a path.

        Raises ``WRONG_NETWORK`` if there is another peer at the other end of this network.
        """
        if self.peer_at.get(path.socket, peer) is not peer:
            raise Drop(DropReason.WRONG_NETWORK)
