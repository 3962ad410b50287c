"""What a daemon knows at one moment, in the words of the problems of :mod:`.diagnosis`. It changes nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property, partial
from typing import Final, NamedTuple

from uavlinkd.config import EndpointConfig
from uavlinkd.config.keys import encode_key
from uavlinkd.core.drops import DropReason
from uavlinkd.core.path import SocketAddress
from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.link.evidence import ELSEWHERE, REPORTED, Sighting
from uavlinkd.link.parts import DaemonParts
from uavlinkd.link.peer_link import PeerLink
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


class Moment:
    """A daemon. Make one for all findings of a moment."""

    def __init__(self, daemon: DaemonParts, now: float) -> None:
        self.daemon = daemon
        self.now = now
        self.down = [link for link in daemon.links.values() if not link.peer.is_up]
        """The peers that are not up."""
        self.has_sole_waiting = sum(not link.config.addresses for link in self.down) == 1
        """Whether one peer without addresses is not up: a sender at an unknown address may be this one."""

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
        return self._current(self.daemon.evidence.seen(kind, self.link, self.now), kind, self.link)

    def handshake_seen(self, reason: DropReason) -> Sighting | None:
        """The same; of a peer without addresses, from any sender while it is the only such peer that is not up."""
        if self.link.config.addresses or self.link.relayed:
            return self.seen(reason)
        if not self.moment.has_sole_waiting:
            return None
        return self._current(self.daemon.evidence.seen_at(reason, ELSEWHERE, self.now), reason, self.link)

    def seen_at(self, relay: RelayLink, kind: str) -> Sighting | None:
        """Evidence at an address of a relay since that went silent."""
        return self._current(self.daemon.evidence.seen_at_relay(kind, relay, self.now), kind, relay)

    def _current(self, sighting: Sighting | None, kind: str, link: PeerLink | RelayLink) -> Sighting | None:
        """A sighting since the link went down. An ICMP message counts until two tries had none."""
        if sighting is None or sighting.last_at < link.silent_since:
            return None
        tries = link.peer.initiator
        is_over = self.now - sighting.last_at > 2 * (tries.retry_at - tries.initiated_at) + ICMP_S
        return None if kind.startswith(REPORTED) and is_over else sighting


class EndpointFacts(PartFacts):
    """A local endpoint."""

    def __init__(self, moment: Moment, endpoint: Endpoint, config: EndpointConfig) -> None:
        super().__init__(moment, "endpoint", endpoint.name, config.policy)
        self.endpoint = endpoint
        self.config = config


def at(sighting: Sighting) -> str:
    """Where it was seen."""
    return place(sighting.address)


def place(address: SocketAddress | None) -> str:
    """An address, which may be unknown."""
    return "its address" if address is None else shown(address)


def keys_at(sighting: Sighting, but: bytes | None = None) -> str:
    """The public keys of senders, each with the address where it was seen last."""
    keys = ((key, address) for key, address in sighting.details.items() if isinstance(key, bytes) and key != but)
    return ", ".join(f"{encode_key(key)} at {place(address)}" for key, address in keys)


def listed(names: Iterable[str], most: int = 4) -> str:
    """The first names of a list that an attacker may make long."""
    first = list(names)
    return ", ".join(first[:most]) + (f" and {len(first) - most} more" if len(first) > most else "")
