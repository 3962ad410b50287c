"""What a leaf adds to the daemon: a :class:`Feature` takes part in its work, a :class:`PathKind` is beside UDP.

The daemon imports no leaf. :mod:`.parts` makes those that the configuration file has, and the daemon calls them here.
Times are monotonic seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from types import UnionType
from typing import Protocol

from uavlinkd.config.model import NetworkConfig, PeerAddress, PeerConfig, RelayConfig
from uavlinkd.daemon.networks import NetworkBudget, Receive
from uavlinkd.io.sockets import Presence
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import DropReason, Reason
from uavlinkd.protocol.outputs import Event, Output, RecordReceived
from uavlinkd.protocol.path import Path, SocketAddress
from uavlinkd.protocol.peer import Peer

WaitingDatagram = tuple[bytes, Path]
"""A datagram and the path on which it arrived."""
Sender = Callable[[bytes, SocketAddress], object]
"""Sends a datagram to an address. Raises OSError."""


class Reachable(Protocol):
    """A peer, or a relay, at the addresses of its configuration."""

    peer: Peer
    """Its object in the core."""
    name: str

    @property
    def config(self) -> PeerConfig | RelayConfig:
        """Its section of the configuration."""

    def set_paths(self, paths: Sequence[Path], now: float) -> None:
        """Connect to it along these paths."""


class FeatureHost(Protocol):
    """What the daemon does for a feature."""

    arm: Callable[[], object]
    """Sets the timer of the daemon: a feature may have an earlier deadline."""

    def perform(self, outputs: Sequence[Output]) -> None:
        """Execute outputs of the core."""

    def drop_datagram(self, reason: DropReason, name: str = "", path: Path | None = None) -> None:
        """Count a datagram that the core does not drop."""


class Feature:
    """A part of the daemon that only some files configure. Each overrides what it needs."""

    records: tuple[type, ...] | UnionType = ()
    """The kinds of records that it receives."""

    @property
    def next_at(self) -> float:
        """When :meth:`do_due` has something to do. The daemon looks after each event and record."""
        return NEVER

    def do_due(self, now: float) -> None:
        """Do what is due."""

    def on_event(self, event: Event, now: float) -> None:
        """An event of the core, of any peer."""

    def on_record(self, received: RecordReceived, now: float) -> DropReason | None:
        """A record of one of its kinds came. Returns why it has no effect; None if it has one."""
        return DropReason.UNEXPECTED_RECORD

    def follow_links(self, now: float) -> None:
        """The peers of the daemon, or their settings, changed."""

    def do_housekeeping(self, now: float) -> None:
        """Once a second."""

    def count_drops(self) -> Iterable[tuple[Reason, str, int]]:
        """The datagrams that it dropped since the last call: reason, name of a member or nothing, count."""
        return ()


class NetworkFacts(Protocol):
    """A network of the configuration, as people see it."""

    @property
    def config(self) -> NetworkConfig:
        """Its section."""

    @property
    def presence(self) -> Presence:
        """What the machine has of it now."""

    @property
    def remedy(self) -> str:
        """What a person can do while it is absent."""

    def status(self) -> dict[str, object]:
        """As plain values."""


class AddSender(Protocol):
    """Reserves the next socket number, and returns it. Without a budget, what is sent along it is not charged."""

    def __call__(
        self, send: Sender, budget: NetworkBudget | None = None, envelope_limit: int | None = None
    ) -> int: ...


class PathKind:
    """A kind of path that is not a UDP socket: it has socket numbers of its own. Each overrides what it needs."""

    networks: Sequence[NetworkFacts] = ()

    def open(self, add: AddSender) -> None:
        """Open what the daemon cannot start without. Raises BindError."""

    def start(self, receive: Receive, on_change: Callable[[], None], on_room: Callable[[], None]) -> None:
        """Receive from now on. ``on_change``: the core got another state of a path. ``on_room``: frames may leave."""

    def path_to(self, written: PeerAddress) -> Path | None:
        """The path to an address of the configuration; None if it is of another kind."""
        return None

    def network_name(self, number: int) -> str | None:
        """What people see as the network of a socket; None if it is of another kind."""
        return None

    def follow(self, link: Reachable) -> None:
        """Keep the paths to a peer or relay open."""

    def unfollow(self, link: Reachable) -> None:
        """Keep them open no more."""

    def follow_links(self, links: Iterable[Reachable]) -> None:
        """These are all peers of the daemon from now on."""

    def report_state(self) -> None:
        """Report what is closed to the core. The daemon calls it after other paths were set."""

    def do_housekeeping(self) -> None:
        """Once a second."""

    def close(self) -> None:
        """End all connections."""
