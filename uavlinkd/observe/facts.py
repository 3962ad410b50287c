"""What a daemon knows at one moment, in the words that the findings of :mod:`.findings` need. It changes nothing."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

from uavlinkd.config.keys import encode_key
from uavlinkd.config.model import EndpointConfig
from uavlinkd.daemon.evidence import ELSEWHERE, EVIDENCE_S, REPORTED, Sighting
from uavlinkd.daemon.parts import DaemonParts
from uavlinkd.daemon.peer_link import NOT_ANSWERING_S, PeerLink
from uavlinkd.io.ports import Endpoint
from uavlinkd.io.url import EndpointKind
from uavlinkd.observe.history import History
from uavlinkd.ops.log import shown
from uavlinkd.protocol.drops import Detail, DropReason
from uavlinkd.protocol.path import Path, SocketAddress, relay_name
from uavlinkd.protocol.path_state import PathCondition
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.sessions import Twin
from uavlinkd.system.error_meanings import meaning_of

if TYPE_CHECKING:
    from uavlinkd.mavlink.signing.endpoint_signing import EndpointSigning
    from uavlinkd.relay.client_link import RelayLink

Fields = dict[str, Any]
"""The values of a finding that its sentences name."""

SECURITY_S: Final = 600.0
"""A finding about an attack stays for this time after the last evidence."""
ICMP_S: Final = 1.0
"""Hosts send an ICMP message about our datagrams at most once in this time."""
REPORTED_S: Final = 5.0
"""An ICMP message about a relay counts for this time: two tries, and more."""
UNREACHABLE: Final = ("EHOSTUNREACH", "ENETUNREACH", "EACCES")
"""Errors that ICMP messages report, except a closed port."""
UNROUTED: Final = ("ENETUNREACH", "EHOSTUNREACH", "ENETDOWN", "EADDRNOTAVAIL", "EINVAL", "EMSGSIZE", "EAFNOSUPPORT")
"""Errors of sending that are certain: this machine's kernel reports them at once."""
SILENT_S: Final = 5.0
"""An endpoint without frames for this time is reported: MAVLink clients send a heartbeat every second. Its errors
count for the same time. It is opened again more often."""
ANSWERED_FRAMES: Final = 20
"""Ground control software speaks only after a vehicle does. It answers before it has received so many frames."""
NOT_LISTENING: Final = "ECONNREFUSED"
KERNEL_ERRORS: Final = frozenset(errno.errorcode.values())


class Moment:
    """A daemon. Make one for all findings of a moment."""

    def __init__(self, daemon: DaemonParts, history: History, now: float) -> None:
        self.daemon = daemon
        self.history = history
        self.now = now
        of_fleet = "on the laptop, run `uavlinkd fleet enroll HOST --replace --service` for one of them"
        self.fields: Fields = {
            "here": daemon.config.name,
            "renew": "run `uavlinkd keygen` on one" if daemon.fleet is None else of_fleet,
        }
        self.down = [link for link in daemon.links.values() if not is_reached(daemon, link.peer, now)]
        """The peers that frames do not reach."""
        self.has_sole_waiting = sum(not link.config.addresses for link in self.down) == 1
        """Whether one peer without addresses is not up: a sender at an unknown address may be this one."""

    def current(self, sighting: Sighting | None, kind: str, link: PeerLink | RelayLink) -> Sighting | None:
        """A sighting since the link went down. An ICMP message counts until two tries had none."""
        if sighting is None or sighting.last_at < link.silent_since:
            return None
        tries = link.peer.initiator
        is_over = self.now - sighting.last_at > 2 * (tries.retry_at - tries.initiated_at) + ICMP_S
        return None if kind.startswith(REPORTED) and is_over else sighting

    # Relays.

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
        return next((match for match in errors if match[0]), None)

    @cached_property
    def silent_relays(self) -> list[RelayLink]:
        """The relays that do not answer."""
        return [
            relay
            for relay in self.daemon.relay_links.values()
            if not is_reached(self.daemon, relay.peer, self.now) and self.now - relay.silent_since >= NOT_ANSWERING_S
        ]


class PartFacts:
    """A peer or an endpoint."""

    def __init__(self, moment: Moment, kind: str, name: str, rules: Mapping[str, object]) -> None:
        self.moment, self.daemon, self.now = moment, moment.daemon, moment.now
        self.name = name
        self.history = moment.history.part(kind, name)
        self.rules = rules
        """Its policy, as the file has it."""
        self.is_certified = False
        self.fields = moment.fields | {
            "who": name,
            "rule": f"role {rules['role']}" if "role" in rules else "its policy",
        }

    @cached_property
    def blocked(self) -> list[str]:
        """The directions in which its policy recently refused all frames."""
        return self.history.blocked(self.now)


class PeerFacts(PartFacts):
    """A peer."""

    def __init__(self, moment: Moment, link: PeerLink) -> None:
        super().__init__(moment, "peer", link.name, link.config.policy)
        self.link = link
        self.is_certified = link.config.settings.is_certified
        self.addresses = listed(map(str, link.config.addresses))
        """Addresses of the peer in the file, as a text."""
        self.is_up = is_reached(self.daemon, link.peer, self.now)
        self.is_overdue = not self.is_up and self.now - link.silent_since >= NOT_ANSWERING_S
        """Whether to report that the peer is silent."""

    def seen(self, kind: str) -> Sighting | None:
        """Evidence since the link went down."""
        return self.moment.current(self.daemon.evidence.seen(kind, self.link, self.now), kind, self.link)

    def handshake_seen(self, reason: DropReason) -> Sighting | None:
        """Evidence of a handshake since the link went down.

        Of a peer without addresses: from any sender, while it is the only such peer that is not up.
        """
        if self.link.config.addresses or self.link.relayed:
            return self.seen(reason)
        if not self.moment.has_sole_waiting:
            return None
        return self.moment.current(self.daemon.evidence.seen_at(reason, ELSEWHERE, self.now), reason, self.link)

    @cached_property
    def relays(self) -> list[RelayLink]:
        """The relays of the peer."""
        by_name = self.daemon.relay_links
        return [by_name[name] for name in self.link.config.relays if name in by_name]

    @property
    def lacks_relay(self) -> bool:
        """Whether a relay is silent and no other one forwards to the peer: that has a line of its own."""
        return not self.is_bound and any(relay in self.moment.silent_relays for relay in self.relays)

    @cached_property
    def is_bound(self) -> bool:
        """Whether a relay forwards to the peer."""
        bound = [relay for relay in self.relays if relay.state_for(self.link) == "bound"]
        return any(is_reached(self.daemon, relay.peer, self.now) for relay in bound)


class EndpointFacts(PartFacts):
    """A local endpoint."""

    def __init__(self, moment: Moment, endpoint: Endpoint, config: EndpointConfig) -> None:
        super().__init__(moment, "endpoint", endpoint.name, config.policy)
        self.endpoint = endpoint
        self.config = config
        self.fields["url"] = config.url

    @cached_property
    def silence(self) -> tuple[str, Fields]:
        """Why no MAVLink comes from its client: a cause, with the fields of its sentences; "" while frames come."""
        silent_s = self.now - self.history.silent_since
        if silent_s < SILENT_S:
            return "", {}
        url, ports = self.config.url, self.endpoint.ports
        if url.kind is EndpointKind.STATION:  # a tablet may be off
            return "", {}
        failures = self.history.failures.within(SILENT_S, self.now)
        error = next((name for name in failures if name in KERNEL_ERRORS or name == "connect_timeout"), "")
        # A client of `udpin` has sent MAVLink: the bytes are another sender's.
        is_known = url.kind is EndpointKind.UDPIN and bool(ports)
        if not is_known and self.history.garbage.within(SILENT_S, self.now):
            return "garbage", {}
        if ports and not (url.kind is EndpointKind.UDPOUT and error):
            clients = listed(port.name for port in ports)
            what, advice = f"the client {clients} has sent no MAVLink for {silent_s:.0f} s", "look whether it runs"
            if url.kind is EndpointKind.UDPOUT:
                if self.endpoint.frames_sent < ANSWERED_FRAMES:
                    return "", {}
                what, advice = f"no ground control software or other client answers on {clients}", "open it"
            of_kind = "look at wiring and baud rate" if url.kind is EndpointKind.SERIAL else "it must not only listen"
            return "client_silent", {"what": what, "advice": f"{advice}; {of_kind}"}
        if url.kind is EndpointKind.SERIAL:
            error = next(iter(failures), "")
            meaning = meaning_of(error) or "plug the device in"
            return "device_unavailable", {"error": f" ({error})" if error else "", "meaning": meaning}
        if url.listens and not ports:
            return "no_client", {"silent_s": silent_s}
        if "not_resolved" in failures or (url.kind is EndpointKind.UDPOUT and not ports):
            why, meaning = "its host has no address now", "write an IP address, or see `getent hosts NAME`"
        elif error in ("", NOT_LISTENING, "connect_timeout"):
            why, meaning = "no process listens there", "start the client there, or correct the port"
        else:
            why, meaning = "it fails", meaning_of(error)
        return "client_unreachable", {"why": f"{why} ({error})" if error else why, "meaning": meaning}


def hosts_of(relay: RelayLink) -> set[str]:
    """The hosts of a relay's addresses, as they are resolved now."""
    return {path.host for path in relay.peer.paths.configured if path.is_udp}


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


def proves_key(signing: EndpointSigning, now: float) -> bool:
    """Whether frames with the signature of a proven key come from an endpoint's autopilot now."""
    return signing.is_proven and now - signing.verified_at < SILENT_S


def is_reached(daemon: DaemonParts, peer: Peer, now: float) -> bool:
    """Whether frames reach a peer. The core of an idle link asks only every 10 s whether its paths still answer."""
    states, lost = peer.paths.states, {name for name, relay in daemon.relay_links.items() if not relay.peer.is_up}
    if not states or peer.received_at is None or now - peer.received_at < peer.lost_after_s:
        return peer.is_up
    works = (one.condition is not PathCondition.DOWN and relay_name(one.path.address) not in lost for one in states)
    return peer.is_up and any(works)


def has_twin(peer: Peer, twin: Twin, now: float, within_s: float = SECURITY_S) -> bool:
    """Whether the sessions with a peer showed a second process with a private key."""
    return twin in peer.sessions.twins and now - peer.sessions.twins[twin] < within_s


def is_contested(peer: Peer, now: float) -> bool:
    """Whether two processes with one key displace each other now: each loses about half of the frames."""
    return any(has_twin(peer, twin, now, EVIDENCE_S) for twin in Twin)


def places_of(peer: Peer) -> str:
    """Where a peer answered."""
    answered = (state for state in peer.paths.states if state.is_validated or state.is_known)
    return listed(dict.fromkeys(shown(state.path.address) for state in answered)) or "an unknown address"
