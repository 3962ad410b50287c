"""What a daemon knows at one moment, in the words of the problems of :mod:`.diagnosis`. It changes nothing."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cached_property, partial
from ipaddress import ip_address
from itertools import combinations
from typing import Final, NamedTuple

from uavlinkd.config.keys import encode_key
from uavlinkd.config.model import EndpointConfig
from uavlinkd.core.drops import Detail, DropReason
from uavlinkd.core.path import Path, SocketAddress, relay_name
from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.link.direct_search import is_private
from uavlinkd.link.evidence import ELSEWHERE, REPORTED, Sighting
from uavlinkd.link.parts import DaemonParts
from uavlinkd.link.peer_link import NOT_ANSWERING_S, PeerLink
from uavlinkd.link.relay_link import RelayLink
from uavlinkd.ops.findings import Severity
from uavlinkd.ops.log import shown


class Found(NamedTuple):
    """A problem that is there, and what the operator does: one sentence each, without a full stop."""

    severity: Severity
    """By this the alerts select."""
    cause: str
    """Its code in ``status --json``, in the log and in the label of the metric ``finding``."""
    text: str
    remedy: str


security: Final = partial(Found, Severity.SECURITY)
fault: Final = partial(Found, Severity.FAULT)
warning: Final = partial(Found, Severity.WARNING)


ICMP_S: Final = 1.0
"""Hosts send an ICMP message about our datagrams at most once in this time."""
REPORTED_S: Final = 5.0
"""An ICMP message about a relay counts for this time: two tries, and more."""
UNREACHABLE: Final = ("EHOSTUNREACH", "ENETUNREACH", "EACCES")
"""Errors that ICMP messages report, except a closed port."""
UNROUTED: Final = ("ENETUNREACH", "EHOSTUNREACH", "ENETDOWN", "EADDRNOTAVAIL", "EINVAL", "EMSGSIZE", "EAFNOSUPPORT")
"""Errors of sending that are certain: this machine's kernel reports them at once."""
PASSES_S: Final = 2.0
"""A relay forwards if a datagram came through it within this time."""
TRIES: Final = 3
"""A path is silent if so many datagrams were sent along it at least."""


class Moment:
    """A daemon. Make one for all findings of a moment."""

    def __init__(self, daemon: DaemonParts, now: float) -> None:
        self.daemon = daemon
        self.now = now
        self.down = [link for link in daemon.links.values() if not link.peer.is_up]
        """The peers that are not up."""
        self.has_sole_waiting = sum(not link.config.addresses for link in self.down) == 1
        """Whether one peer without addresses is not up: a sender at an unknown address may be this one."""

    # Where UDP gets an answer.

    def current(self, sighting: Sighting | None, kind: str, link: PeerLink | RelayLink) -> Sighting | None:
        """A sighting since the link went down. An ICMP message counts until two tries had none."""
        if sighting is None or sighting.last_at < link.silent_since:
            return None
        tries = link.peer.initiator
        is_over = self.now - sighting.last_at > 2 * (tries.retry_at - tries.initiated_at) + ICMP_S
        return None if kind.startswith(REPORTED) and is_over else sighting

    def seen_at(self, relay: RelayLink, kind: str) -> Sighting | None:
        """Evidence at an address of a relay since that went silent."""
        return self.current(self.daemon.evidence.seen_at_relay(kind, relay, self.now), kind, relay)

    def reported_at(self, path: Path) -> str:
        """The error that ICMP messages report about an address now; empty for none."""
        evidence, place = self.daemon.evidence, ("address", path.address)
        for error in ("ECONNREFUSED", *UNREACHABLE):
            sighting = evidence.seen_at(REPORTED + error, place, self.now)
            if sighting is not None and self.now - sighting.last_at <= REPORTED_S:
                return error
        return ""

    def reported(self, relay: RelayLink) -> tuple[str, Path] | None:
        """The first such error at an address of a relay."""
        errors = ((self.reported_at(path), path) for path in relay.peer.paths.configured)
        return next((found for found in errors if found[0]), None)

    def is_silent(self, relay: RelayLink) -> bool:
        """Whether a relay does not answer, and no fact of this machine is known to be the reason."""
        is_over = not relay.peer.is_up and self.now - relay.silent_since >= NOT_ANSWERING_S
        place = "relay", relay.config.name
        refused = self.daemon.evidence.seen_at(DropReason.BAD_HANDSHAKE, place, self.now)
        certain = (self.seen_at(relay, error) for error in ("EPERM", *UNROUTED))
        has_address = bool(relay.peer.paths.configured)  # by UDP or TLS
        return is_over and has_address and refused is None and not any(certain)

    @cached_property
    def silent_relays(self) -> list[RelayLink]:
        """Those of this daemon."""
        return [relay for relay in self.daemon.relays.by_name.values() if self.is_silent(relay)]

    @cached_property
    def is_udp_blocked(self) -> bool:
        """Whether it probably is: relays on two hosts are silent, none answers, and no ICMP message says why."""
        relays = [relay for relay in self.silent_relays if hosts_of(relay)]
        if len(self.silent_relays) < len(self.daemon.relays.by_name) or any(map(self.reported, relays)):
            return False
        is_far = any(one.isdisjoint(other) for one, other in combinations(map(hosts_of, relays), 2))
        return is_far and not self.beside_relays

    @cached_property
    def beside_relays(self) -> str:
        """A partner that answers directly, as near as the silent relays."""
        return self.other_answer(set[str]().union(*map(hosts_of, self.silent_relays)))

    @cached_property
    def answering(self) -> dict[str, str]:
        """The hosts that answer directly: a peer or relay at each, by name and address."""
        partners: list[PeerLink | RelayLink] = [*self.daemon.relays.by_name.values(), *self.daemon.links.values()]
        return {
            path.host: f"{partner.config.name} at {shown(path.address)}"
            for partner in partners
            for path in self.working(partner)
        }

    def working(self, partner: PeerLink | RelayLink) -> list[Path]:
        """The paths along which a partner answers directly over UDP."""
        states = partner.peer.paths.states if partner.peer.is_up else ()
        return [state.path for state in states if state.works and state.is_validated and state.path.is_udp]

    def other_answer(self, hosts: Collection[str]) -> str:
        """A partner that answers at none of these hosts, but at one as near: UDP gets out."""
        near = set(map(_nearness, hosts))
        others = (who for host, who in self.answering.items() if host not in hosts and _nearness(host) in near)
        return next(others, "")

    def passes(self, relay: RelayLink) -> bool:
        """Whether a relay forwards datagrams to this daemon."""
        states = (state for link in self.daemon.links.values() for state in link.peer.paths.states)
        return any(
            relay_name(state.path.address) == relay.config.name and self.now - state.received_at < PASSES_S
            for state in states
        )

    def silent_paths(self, relay: RelayLink) -> Iterator[Path]:
        """The configured addresses of a relay from which no answer comes."""
        for state in relay.peer.paths.states:
            is_over = state.datagrams_sent >= TRIES and self.now - state.since >= NOT_ANSWERING_S
            if state.is_configured and not state.works and not state.is_off and is_over and state.path.is_udp:
                yield state.path

    def owner(self, system: int, other_than: str) -> str | None:
        """A peer, or an endpoint here, that has a MAVLink system id, except the one of this name."""
        return next((name for name in self._owners.get(system, ()) if name != other_than), None)

    @cached_property
    def _owners(self) -> Mapping[int, list[str]]:
        """By the file, or because frames of the system were received. Looked up once for all peers."""
        owners: dict[int, list[str]] = {}
        for system, name in self._systems():
            owners.setdefault(system, []).append(name)
        return owners

    def _systems(self) -> Iterator[tuple[int, str]]:
        links, router = self.daemon.links.values(), self.daemon.switch.router
        for link in links:
            for system in link.policy.incoming.systems or ():
                yield system, link.name
        for endpoint in self.daemon.local.endpoints:
            for system in {system for port in endpoint.ports for system, _ in router.addresses(port)}:
                yield system, f"endpoint {endpoint.name}"
        for link in links:
            for system in {system for system, _ in router.addresses(link)}:
                yield system, link.name


class PartFacts:
    """A peer or an endpoint."""

    def __init__(self, moment: Moment, kind: str, name: str, rules: Mapping[str, object]) -> None:
        self.moment, self.daemon, self.now = moment, moment.daemon, moment.now
        self.name = name
        self.owner = name if kind == "peer" else f"{kind} {name}"
        """Its name among those that have system ids."""
        self.history = moment.daemon.history.part(kind, name)
        self.rules = rules
        """Its policy, as the file has it,"""
        self.rule = f"role {rules['role']}" if "role" in rules else "its policy"
        """and in two words."""


class PeerFacts(PartFacts):
    """A peer."""

    def __init__(self, moment: Moment, link: PeerLink) -> None:
        super().__init__(moment, "peer", link.name, link.config.policy)
        self.link = link
        self.addresses = listed(map(str, link.config.addresses))
        """Those of the file."""

    def seen(self, kind: str) -> Sighting | None:
        """Evidence since the link went down."""
        return self.moment.current(self.daemon.evidence.seen(kind, self.link, self.now), kind, self.link)

    def handshake_seen(self, reason: DropReason) -> Sighting | None:
        """The same; of a peer without addresses, from any sender while it is the only such peer that is not up."""
        if self.link.config.addresses or self.link.relayed:
            return self.seen(reason)
        if not self.moment.has_sole_waiting:
            return None
        return self.moment.current(self.daemon.evidence.seen_at(reason, ELSEWHERE, self.now), reason, self.link)


class EndpointFacts(PartFacts):
    """A local endpoint."""

    def __init__(self, moment: Moment, endpoint: Endpoint, config: EndpointConfig) -> None:
        super().__init__(moment, "endpoint", endpoint.name, config.policy)
        self.endpoint = endpoint
        self.config = config


def hosts_of(relay: RelayLink) -> set[str]:
    """Those of its addresses, as they are resolved now."""
    return {path.host for path in relay.peer.paths.configured if path.is_udp}


def _nearness(host: str) -> tuple[bool, bool]:
    """On this machine, in a private network, or beyond."""
    return ip_address(host).is_loopback, is_private(host)


def at(sighting: Sighting) -> str:
    """Where it was seen."""
    return place(sighting.address)


def place(address: SocketAddress | None) -> str:
    """An address, which may be unknown."""
    return "its address" if address is None else shown(address)


def details_at(details: Mapping[Detail, SocketAddress | None]) -> str:
    """The public keys or certificates of senders, each with the address where it was seen last."""
    shown_at = ((encode_key(one) if isinstance(one, bytes) else one, at) for one, at in details.items())
    return ", ".join(f"{detail} at {place(address)}" for detail, address in shown_at)


def listed(names: Iterable[str], most: int = 4) -> str:
    """The first names of a list that an attacker may make long."""
    first = list(names)
    return ", ".join(first[:most]) + (f" and {len(first) - most} more" if len(first) > most else "")
