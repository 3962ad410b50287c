"""Relays and their members in the simulated network: the node, and around it what a daemon has for relays.

A relay has its members in its configuration, or accepts those with a certificate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from random import Random
from typing import Final

import structlog

from tests.authority.signing import AUTHORITY, bulletin
from tests.daemon.inside import handle_tables, set_own_sockets
from tests.network.air import Address
from tests.network.drone import Drone
from tests.network.network import Network
from uavlinkd.authority.trust import Trust
from uavlinkd.config.build import TIMERS
from uavlinkd.config.model import PeerAddress, PeerConfig, RelayConfig
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.daemon.peer_sockets import Wrap
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.crypto import Entropy
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.path import RELAY_HOST, Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import RELAYED_START, Bind, CertificateRecord
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.relay.bindings import QUARANTINED_PER_MEMBER
from uavlinkd.relay.client_link import RelayLink
from uavlinkd.relay.clients import Relays
from uavlinkd.relay.direct_search import OwnSocket
from uavlinkd.relay.forwarding import MemberSettings
from uavlinkd.relay.service import RelayService, RelayShell
from uavlinkd.system import addresses

HOUSEKEEPING_S: Final = 1.0
MOST_PEERS: Final = 8
FEATURES: Final = c.KNOWN_FEATURES
LINK: Final = Link(features=FEATURES)
BULLETIN: Final = bulletin(1 << 24)
_LIMITS: Final = 200_000_000
_REMEMBERED_S: Final = c.BIND_LIFETIME_S + c.QUESTION_LIFETIME_S + HOUSEKEEPING_S
"""A bind has no effect later than this."""
_QUIET: Final = structlog.make_filtering_bound_logger("critical")
_LOG: Final = structlog.wrap_logger(structlog.ReturnLogger(), wrapper_class=_QUIET)


class Relay(Drone):
    """A relay with a public address. It carries no frames of its own."""

    def __init__(self, world: Network, name: str, address: Address, clock: float = 0.0) -> None:
        super().__init__(world, name, (address,), clock)
        self.members: dict[bytes, str] = {}
        self.trust: Trust | None = None
        """In a fleet with an authority."""
        self.service: RelayService | None = None
        self.forwarded = 0
        self._asked: dict[tuple[str, str], float] = {}
        self._arrived: tuple[Path, int] | None = None
        self._housekeeping_at = 0.0

    def certify(self) -> None:
        """Accept certificates from the start on, and have no members in the configuration."""
        self.on_certificate = self._admit

    def start(self, clock: float | None = None) -> None:
        super().start(clock)
        assert self.node is not None
        if self.on_certificate is not None:
            self.trust = Trust(AUTHORITY, self.public_key, b"", BULLETIN)
        shell = RelayShell(
            entropy=Random(self._world.rng.randbytes(16)).randbytes,
            clock=lambda: self.local_now,
            perform=partial(self._world.perform, self),
            send=self._forward,
            on_event=lambda event, now: None,
        )
        self.service = RelayService(self.node, _LIMITS, shell)
        members = {
            key: MemberSettings(PeerSettings(name, key, None, LINK), MOST_PEERS, _LIMITS)
            for key, name in self.members.items()
            if self.on_certificate is None
        }
        self.service.set_members(members, {}, self.local_now)
        self._housekeeping_at = self.local_now + HOUSEKEEPING_S

    def _admit(self, key: bytes, certificate: bytes, now: float) -> PeerSettings:
        assert self.trust is not None
        self.trust.judge(key, certificate)
        return PeerSettings(self.members[key], key, None, LINK, is_certified=True)

    def has_asked(self, name: str, other: str) -> bool:
        """Whether one member asked for another one recently."""
        return self._world.now <= self._asked.get((name, other), -math.inf) + _REMEMBERED_S

    def receive(self, datagram: bytes, path: Path) -> None:
        """Forward data, and pass anything else to the node."""
        assert self.service is not None
        if datagram[:1] == RELAYED_START:
            self._arrived = path, len(datagram)
            self.service.forwarding.take(path.socket, datagram, path.address)
            self._arrived = None
        else:
            super().receive(datagram, path)
            self.service.settle(self.local_now)

    def _forward(self, datagram: bytes, path: Path) -> None:
        """Both members must have asked for the other one, and one datagram causes one that is not longer."""
        assert self._arrived is not None, f"{self.name} sends data that did not arrive"
        arrived, size = self._arrived
        self._arrived = None
        assert len(datagram) <= size
        sender, receiver = (self._world.owners[one.address[:2]] for one in (arrived, path))
        for asking in ((sender, receiver), (receiver, sender)):
            assert self.has_asked(*asking), f"{self.name} forwards, but {asking} is not asked for"
        self.forwarded += 1
        self._world.perform(self, [o.Transmit(datagram, path)])

    def on_record(self, received: o.RecordReceived) -> None:
        """Members ask for others."""
        assert self.service is not None
        if isinstance(received.record, Bind):
            for key in received.record.keys:
                if (name := self.members.get(key)) is not None:
                    self._asked[received.peer.name, name] = self._world.now
        self.service.on_record(received, self.local_now)

    def on_event(self, event: o.Event) -> None:
        assert self.service is not None
        if isinstance(event, o.PeerAdmitted):
            assert self.trust is not None
            assert isinstance(event.peer, Peer)
            settings = event.peer.settings
            self.trust.hold(settings.public_key, event.certificate)
            assert self.node is not None
            self.node.accept(event.peer)
            member, held = MemberSettings(settings, MOST_PEERS, _LIMITS), self.trust.held[settings.public_key]
            self.service.admit(event.peer, member, held, self.local_now, is_own=True)
        self.service.on_event(event, self.local_now)

    def next_deadline(self) -> float:
        """When something is due, on its clock."""
        return min(super().next_deadline(), self._housekeeping_at) if self.node is not None else math.inf

    def handle_timeout(self) -> None:
        """Wake the node, and do the housekeeping of a daemon."""
        assert self.service is not None
        now = max(self.local_now, self.next_deadline())
        self._perform_timeout(now)
        if now >= self._housekeeping_at:
            self._housekeeping_at = now + HOUSEKEEPING_S
            self.service.do_housekeeping(now)
        self.service.settle(now)

    def check_bounds(self) -> None:
        super().check_bounds()
        if self.node is None:
            return
        assert self.service is not None
        bindings, forwarding = self.service.bindings, self.service.forwarding
        for member in bindings._members.values():
            assert len(member.wishes) <= MOST_PEERS
            assert all(len(wishes) <= c.HANDLES_PER_PAIR for wishes in member.wishes.values())
            assert len(member.quarantine) <= QUARANTINED_PER_MEMBER
            assert len(member.handles) <= MOST_PEERS * c.HANDLES_PER_PAIR
        connections = [connection for of_pair in bindings._pairs.values() for connection in of_pair]
        assert len(connections) == bindings.connections
        assert len(forwarding) <= 2 * bindings.connections
        slots = len(self.members) * (c.CONFIGURED_PATHS + c.LEARNED_PATHS)
        assert sum(map(len, self.service._asked.values())) <= slots
        assert len(self.service._due) <= slots * MOST_PEERS


class _Link(PeerLink):
    """Of a peer link only what relays need: the paths."""

    def __init__(self, config: PeerConfig, node_of: Member, peer: Peer) -> None:  # without what a daemon does more
        assert node_of.node is not None
        self.config, self.name = config, config.name
        self._node, self.peer = node_of.node, peer
        self._direct = self.relayed = ()


class _Sockets:
    """What relays need of a daemon's sockets: each socket reaches each relay."""

    def __init__(self, member: Member) -> None:
        self._member = member
        self.arm = lambda: None

    def use_relays(self, wrap: Wrap) -> None:
        """As a daemon's."""

    def perform(self, outputs: Iterable[o.Output]) -> None:
        """As a daemon's line."""
        self._member.perform(outputs)

    def drop_datagram(self, reason: DropReason, name: str = "", path: Path | None = None) -> None:
        """As a daemon's line."""
        self._member.drops[reason] += 1

    def follow(self, relay: RelayLink) -> None:
        """Connect to a relay from every socket."""
        member = self._member
        relay.set_paths(
            [
                Path(socket, (written.address.host, written.address.port))
                for written in relay.config.addresses
                for socket in range(len(member.addresses))
            ],
            member.local_now,
        )

    def report_absent(self, now: float) -> None:
        """A new path along a socket without network is off."""
        for end in self._member.absent_ends():
            assert self._member.node is not None
            self._member.node.set_socket_state(end, is_up=False, now=now)


class Member(Drone):
    """A daemon that reaches its peers along relays, and searches direct paths."""

    def __init__(
        self, world: Network, name: str, at: Sequence[Address], clock: float = 0.0, *, searches: bool = False
    ) -> None:
        super().__init__(world, name, at, clock)
        self.uses: list[Relay] = []
        self.relays: Relays | None = None
        self.searches = searches
        """Whether it looks for direct paths to its peers."""
        self.links: dict[str, _Link] = {}
        self.tokens_taken = 0
        self.certificate = b""
        """For relays that accept certificates."""
        self.introductions = 0
        self._housekeeping_at = 0.0

    def joins(self, relays: Iterable[Relay]) -> None:
        """Become a member of relays, and use them. They must start later than this."""
        for relay in relays:
            relay.members[self.public_key] = self.name
            self.uses.append(relay)

    def start(self, clock: float | None = None) -> None:
        super().start(clock)
        now = self.local_now
        assert self.node is not None
        self.links = {}
        sockets = _Sockets(self)
        relays = Relays(self.node, sockets, sockets, self.links, {}, _LOG)  # type: ignore[arg-type]
        self.relays = relays
        self.node.set_certificate(self.certificate)
        self._look()
        for name in self.acquaintances:
            self._link(name)
        for relay in self.uses:
            link = replace(LINK, timers=TIMERS)
            is_certified = relay.on_certificate is not None
            settings = PeerSettings(RELAY_HOST + relay.name, relay.public_key, None, link, is_certified=is_certified)
            relays.add(RelayConfig(settings, (PeerAddress(addresses.Address(*relay.addresses[0])),)), now)
        relays.follow_links(now)
        for end in self.absent_ends():
            self.node.set_socket_state(end, is_up=False, now=now)
        self._housekeeping_at = now + HOUSEKEEPING_S

    def _link(self, name: str) -> None:
        assert self.node is not None
        peer = self.node.peers[name]
        config = PeerConfig(peer.settings, (), {}, relays=tuple(relay.name for relay in self.uses))
        self.links[name] = _Link(config, self, peer)
        self.links[name].set_paths(self.acquaintances[name][1], self.local_now)

    def remove(self, other: Drone) -> None:
        """Its relays are not asked for the peer any more."""
        self.links.pop(other.name, None)
        super().remove(other)
        if self.relays is not None and self.node is not None:
            self.relays.follow_links(self.local_now)

    def restore(self, other: Drone) -> None:
        """Its relays are asked for the peer again."""
        super().restore(other)
        if self.relays is not None and self.node is not None:
            self._link(other.name)
            self.relays.follow_links(self.local_now)

    def _entropy(self) -> Entropy:
        return Random(self._world.rng.randbytes(16)).randbytes

    def absent_ends(self) -> list[int]:
        """The sockets whose networks are gone."""
        return [end.socket for end in self._world.air.absent if end.drone == self.name]

    # Datagrams.

    def datagram_for(self, datagram: bytes, path: Path) -> tuple[bytes, Address] | None:
        """Along a relayed path, data for the relay."""
        if not path.is_relayed:
            return super().datagram_for(datagram, path)
        assert self.relays is not None
        wrapped = self.relays.handles.wrap(datagram, path)
        return None if wrapped is None else (wrapped[0], wrapped[1][:2])

    def perform(self, outputs: Iterable[o.Output]) -> None:
        """Execute outputs of its core."""
        self._world.perform(self, list(outputs))

    def receive(self, datagram: bytes, path: Path) -> None:
        """Data from a relay comes along a relayed path."""
        assert self.relays is not None
        if datagram[:1] == RELAYED_START:
            taken = self.relays.handles.unwrap(path.socket, datagram, path.address)
            if isinstance(taken, DropReason):
                self.drops[taken] += 1
                if taken is DropReason.RELAY_UNKNOWN_HANDLE:
                    self.relays.on_unknown_handle(path, self.local_now)
                return
            datagram, path = taken
        super().receive(datagram, path)

    def on_record(self, received: o.RecordReceived) -> None:
        assert self.relays is not None
        if isinstance(received.record, CertificateRecord):
            relay = next(relay for relay in self.uses if received.peer.name == RELAY_HOST + relay.name)
            assert relay.has_asked(relay.members[received.record.key], self.name), "an introduction without a wish"
            self.introductions += 1
            return
        reason = self.relays.on_record(received, self.local_now)
        if reason is not None:
            self.drops[reason] += 1

    def on_event(self, event: o.Event) -> None:
        assert self.relays is not None
        self.relays.on_event(event, self.local_now)

    # Time.

    def next_deadline(self) -> float:
        """When something is due, on its clock."""
        if self.node is None or self.relays is None:
            return math.inf
        return min(super().next_deadline(), self._housekeeping_at, self.relays.next_at)

    def handle_timeout(self) -> None:
        """Wake the node and the relays, and do the housekeeping of a daemon."""
        assert self.node is not None
        assert self.relays is not None
        now = max(self.local_now, self.next_deadline())
        self._perform_timeout(now)
        if now >= self.relays.next_at:
            self.relays.do_due(now)
        if now >= self._housekeeping_at:
            self._housekeeping_at = now + HOUSEKEEPING_S
            self._look()
            self.relays.do_housekeeping(now)

    def _look(self) -> None:
        """What a daemon reads of its machine for the search of direct paths."""
        assert self.relays is not None
        places = enumerate(self.addresses) if self.searches else ()
        own = [
            OwnSocket(number, is_ipv6=False, places=(address,), leads_to=lambda host: False)
            for number, address in places
        ]
        set_own_sockets(self.relays, own)

    def check_bounds(self) -> None:
        super().check_bounds()
        if self.node is None or self.relays is None:
            return
        inward, outward = handle_tables(self.relays.handles)
        assert len(inward) == len(outward)
        to_relays = len(self.uses) * len(self.addresses)
        assert len(outward) <= to_relays * len(self.acquaintances) * c.HANDLES_PER_PAIR
