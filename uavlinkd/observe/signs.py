"""The signs of findings: each function yields the fields of the sentences, once for each finding.

A field named ``severity`` replaces that of the row.

Any sender can forge a datagram or an ICMP message. So a finding from such evidence names its source, and has a remedy
that is safe if the evidence is forged: no remedy accepts a key, a name or an address because it arrived.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

from uavlinkd.config.keys import encode_key
from uavlinkd.daemon.evidence import ELSEWHERE, EVIDENCE_S, REPORTED
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.daemon.switch import Port
from uavlinkd.observe.facts import (
    SECURITY_S,
    UNROUTED,
    Fields,
    Moment,
    PeerFacts,
    at,
    details_at,
    has_twin,
    hosts_of,
    is_reached,
    listed,
    places_of,
)
from uavlinkd.ops.log import shown, titled
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import Detail, DropReason
from uavlinkd.protocol.path import RELAY_HOST, SocketAddress
from uavlinkd.protocol.sessions import Twin
from uavlinkd.system.error_meanings import CONNECTED, meaning_of, web_problem

if TYPE_CHECKING:
    from uavlinkd.relay.client_link import RelayLink

CONFIRM_S: Final = 2.0
"""A handshake that is not complete after this time is reported."""
UNREACHED_S: Final = 15.0
"""A relay that no datagram has reached for this time since its start is reported: its members try more often."""
COMES_BACK: Final = "it comes back by itself; look at its power and its network"

Signs = Iterator[Fields]


# A key in two places.


def own_key_elsewhere(moment: Moment) -> Signs:
    stolen = moment.daemon.evidence.own_key_elsewhere
    if stolen is not None and moment.now - stolen[0] <= SECURITY_S:
        yield {"at": "an unknown address" if stolen[1] is None else shown(stolen[1])}


def own_key_twice(moment: Moment) -> Signs:
    """This daemon's key, as its peers state, and at a relay the keys of its members."""
    peers = moment.daemon.node.peers.items()
    if names := [name.removeprefix(RELAY_HOST) for name, peer in peers if has_twin(peer, Twin.OURS, moment.now)]:
        yield {"facts": f"this daemon's private key: {listed(names)} states a session with another one"}
    relay = moment.daemon.relay
    members = [] if relay is None else [one for one in relay.members.values() if one.is_own]
    if twins := [one for one in members if has_twin(one.peer, Twin.PEERS, moment.now)]:
        names = [f"{one.settings.name}, from {places_of(one.peer)}" for one in twins]
        yield {"facts": f"the private key of a member: {listed(names)}"}


def peers_key_twice(peer: PeerFacts) -> Signs:
    core = peer.link.peer
    if has_twin(core, Twin.PEERS, peer.now):
        yield {"facts": f"{peer.name}'s private key: sessions came from {places_of(core)}"}


# The daemon.


def _severe_if_down(moment: Moment) -> Fields:
    return {} if moment.down else {"severity": "warning"}


def listen_address_missing(moment: Moment) -> Signs:
    if absent := moment.daemon.peer_sockets.absent_addresses():
        yield {
            "addresses": listed(map(str, absent)),
            "wildcard": absent[0].wildcard(),
            **_severe_if_down(moment),
        }


def network_absent(moment: Moment) -> Signs:
    if gone := moment.daemon.peer_sockets.absent_networks():
        advice = "; ".join(dict.fromkeys(gone.values()))
        yield {"networks": "; ".join(gone), "advice": advice, **_severe_if_down(moment)}


def raw_mavlink(moment: Moment) -> Signs:
    raw = moment.daemon.evidence.seen_anywhere(DropReason.RAW_MAVLINK, moment.now)
    if raw is not None and raw.address is not None:
        yield {"at": at(raw)}


def fault_inside(moment: Moment) -> Signs:
    guard = moment.daemon.guard
    if guard.faults and moment.now - guard.last_at <= SECURITY_S:
        yield {"places": listed(f"{place} ({count}x)" for place, count in guard.faults.most_common())}


def configuration_refused(moment: Moment) -> Signs:
    if problems := moment.daemon.journal.refused_file:
        yield {"problems": listed(problems, 1), "file": moment.daemon.config.path}


def frames_in_circle(moment: Moment) -> Signs:
    """Ports from which frames come back that this daemon sent elsewhere."""
    for port, circle in moment.daemon.switch.router.sendings.circles.items():
        if moment.now - circle.returned_at <= EVIDENCE_S and (len(circle.systems) > 1 or circle.is_suspected):
            ways = " or ".join(sorted(map(_port, circle.through - {port}))) or "it"
            yield {"ways": ways, "back": _port(port)}


def _port(port: Port) -> str:
    return port.name if isinstance(port, PeerLink) else f"{port.endpoint.name} ({port.name})"


def line_noise(moment: Moment) -> Signs:
    for network in () if moment.daemon.serial is None else moment.daemon.serial.networks:
        if (noise := network.recent_noise) is not None:
            damaged, whole = noise
            yield {
                "network": network.name,
                "noise": damaged,
                "pieces": damaged + whole,
                "baud": network.line.url.baud,
            }


# The fleet.


def own_certificate_revoked(moment: Moment) -> Signs:
    if (fleet := moment.daemon.fleet) is not None and fleet.trust.own is not None:
        serial = fleet.trust.own.certificate.serial
        if fleet.trust.bulletin.refuses(serial):
            yield {"number": fleet.trust.bulletin.number, "serial": serial}


def bulletin_awaited(moment: Moment) -> Signs:
    if (fleet := moment.daemon.fleet) is not None:
        number, required = fleet.trust.bulletin.number, fleet.config.required_bulletin
        if number < required:
            yield {"number": number, "required": required}


def fleet_state_degraded(moment: Moment) -> Signs:
    if (fleet := moment.daemon.fleet) is not None and fleet.problem:
        yield {"problem": fleet.problem}


def bulletin_conflict(moment: Moment) -> Signs:
    """By whom a bulletin came that contradicts that of this daemon."""
    if (fleet := moment.daemon.fleet) is None:
        return
    from uavlinkd.authority.trust import BulletinVerdict  # noqa: PLC0415  only if configured

    noticed = fleet.noticed(moment.now)
    for event in (BulletinVerdict.CONFLICT.value, BulletinVerdict.SHRINKS.value):
        if event in noticed:
            yield {"by": noticed[event][1]}
            return


def bulletin_rolled_back(moment: Moment) -> Signs:
    """Who stated an older bulletin than before."""
    if (fleet := moment.daemon.fleet) is not None:
        from uavlinkd.authority.exchange import ROLLED_BACK  # noqa: PLC0415  only if configured

        if ROLLED_BACK in (noticed := fleet.noticed(moment.now)):
            yield {"by": noticed[ROLLED_BACK][1]}


_OF_MEMBERS: Final = (
    *(DropReason.BAD_CERTIFICATE, DropReason.CERTIFICATE_REVOKED),
    *(DropReason.MEMBER_CONFLICT, DropReason.ROLE_NOT_ACCEPTED),
)
"""Why this daemon refuses a certificate: its sender is no stranger."""


def _senders(moment: Moment, reason: DropReason) -> dict[Detail, SocketAddress | None]:
    sighting = None if moment.daemon.fleet is None else moment.daemon.evidence.seen_anywhere(reason, moment.now)
    return {} if sighting is None else sighting.details


def member_refused(reason: DropReason) -> Callable[[Moment], Signs]:
    """Senders whose certificate this daemon refused for one reason."""

    def signs(moment: Moment) -> Signs:
        if senders := _senders(moment, reason):
            yield {"senders": details_at(senders)}

    return signs


def not_a_member(moment: Moment) -> Signs:
    """A sender that no other finding names, nor holds a certificate that counts."""
    daemon = moment.daemon
    if daemon.fleet is not None:
        named = {address for reason in _OF_MEMBERS for address in _senders(moment, reason).values()}
        held, unknown = daemon.fleet.trust.held, _senders(moment, DropReason.UNKNOWN_PEER)
        unknown = {key: at for key, at in unknown.items() if key not in held and at not in named}
    elif daemon.relay is not None:
        sighting = daemon.evidence.seen_at(DropReason.UNKNOWN_PEER, ELSEWHERE, moment.now)
        unknown = {} if sighting is None else sighting.details
    else:
        return
    if unknown:
        yield {"senders": details_at(unknown)}


def revoked_but_pinned(peer: PeerFacts) -> Signs:
    """A peer of the configuration, which no bulletin cuts off."""
    fleet = peer.daemon.fleet
    if fleet is not None and not peer.is_certified:
        serial = fleet.exchange.serial(peer.link.key)
        if serial and fleet.trust.bulletin.refuses(serial):
            yield {"serial": serial}


# Relays.


def relay_silent(moment: Moment) -> Signs:
    """Each relay that does not answer: a warning while no peer needs it."""
    needed = {name for link in moment.down for name in link.config.relays}
    for relay in moment.silent_relays:
        if relay.peer.paths.configured or moment.daemon.peer_sockets.unresolved(relay.name):
            yield _silent_relay(moment, relay) | ({} if relay.config.name in needed else {"severity": "warning"})


def no_datagram(moment: Moment) -> Signs:
    """A relay that nothing has reached since its start."""
    daemon, waited_s = moment.daemon, moment.now - moment.history.began_at
    if daemon.relay is not None and not daemon.line.read_at and waited_s >= UNREACHED_S:
        ports = dict.fromkeys(str(address.port) for address in daemon.peer_sockets.addresses)
        yield {"ports": listed(ports), "waited_s": waited_s}


def _by_udp(moment: Moment, relay: RelayLink) -> tuple[str, str]:
    """Why a relay does not answer by UDP, and the remedy, if there is a certain one."""
    if names := sorted(moment.daemon.peer_sockets.unresolved(relay.name)):
        return f"{', '.join(names)} has no address now", f"see `getent hosts {names[0]}`"
    for error in ("EPERM", *UNROUTED):
        if moment.seen_at(relay, error) is not None:
            return web_problem(error)
    if (reported := moment.reported(relay)) is not None:
        error, path = reported
        return f"{shown(path.address)}: {meaning_of(error).partition(':')[0]} ({error}, ICMP)", ""
    if relay.peer.received_at is not None:
        return "it did before, so it is off, or UDP to it or back is blocked", ""
    keys = "" if relay.peer.settings.is_certified else "keys or suites differ, "
    return f"it is off, its address is wrong, {keys}or a firewall drops UDP here or there", ""


def _silent_relay(moment: Moment, relay: RelayLink) -> Fields:
    states = {} if (tls := moment.daemon.tls) is None else tls.states(relay.config.addresses)
    problems = {url: web_problem("silent" if state == CONNECTED else state) for url, state in states.items()}
    reasons = [f"by TLS ({url}) {what}" for url, (what, _) in problems.items()]
    why, advice = _by_udp(moment, relay)
    if hosts_of(relay) or not problems:
        reasons.append(f"by UDP {why}" if problems else why)
    remedies = dict.fromkeys(remedy for remedy in (advice, *(remedy for _, remedy in problems.values())) if remedy)
    if not advice:  # nothing is certain on this machine
        start = f"start {relay.config.name}, and open its firewall and its provider's; `uavlinkd status` there names"
        keys = "; `uavlinkd pubkey` there must print its public_key here, and this daemon must be a member there"
        is_known = relay.peer.settings.is_certified or relay.peer.received_at is not None
        remedies[f"{start} other causes{'' if is_known else keys}"] = None
    return {
        "relay": titled("relay", relay.config.name),
        "addresses": listed(map(str, relay.config.addresses)),
        "why": "; ".join(reasons),
        "advice": "; or ".join(remedies),
    }


def not_bound(peer: PeerFacts) -> Signs:
    if not peer.is_overdue or peer.link.is_closed or peer.is_bound:
        return
    for relay in peer.relays:
        if not is_reached(peer.daemon, relay.peer, peer.now) or relay.state_for(peer.link) != "waiting":
            continue
        name, advice = relay.config.name, COMES_BACK
        if not peer.is_certified:
            advice = (
                f"start it; if it is no member, does not use {name}, or keys differ: compare both public_key with"
                f" `uavlinkd pubkey`, write a [[relay]] for {name} into its file, and a [[member]] into the relay's"
            )
        yield {"relay": titled("relay", name), "advice": advice}


# A peer that is down: what is certain on this machine.


def name_not_resolved(peer: PeerFacts) -> Signs:
    if names := sorted(peer.daemon.peer_sockets.unresolved(peer.name)):
        yield {"names": ", ".join(names), "first": names[0]}


def firewall_here(peer: PeerFacts) -> Signs:
    if (sighting := peer.seen("EPERM")) is not None:
        yield {"at": at(sighting)}


def no_route(peer: PeerFacts) -> Signs:
    sockets = peer.daemon.peer_sockets
    if peer.name in sockets.without_socket:
        listen = peer.daemon.config.listen
        advice = "compare the address families with `ip -brief address`"
        if listen and not sockets.networks.networks:
            advice = f"add {listen[0].wildcard(of_other_version=True)} to listen"
        yield {"at": peer.addresses, "why": "no socket of its address family", "advice": advice}
    if not sockets.absent_addresses():
        errors = ((error, sighting) for error in UNROUTED if (sighting := peer.seen(error)) is not None)
        if (first := next(errors, None)) is not None:
            yield {"at": at(first[1]), "why": first[0], "advice": meaning_of(first[0])}


# Hints: anything here may be forged.


def wrong_key_here(peer: PeerFacts) -> Signs:
    sighting = peer.handshake_seen(DropReason.UNKNOWN_PEER)
    if not peer.is_certified and sighting is not None and (count := len(sighting.details)):
        which = "the key" if count == 1 else f"{count} keys, so at least one is not {peer.name}:"
        yield {"keys": f"{which} {details_at(sighting.details)}"}


def wrong_key_there(peer: PeerFacts) -> Signs:
    if (sighting := peer.handshake_seen(DropReason.BAD_MAC1)) is not None:
        config = peer.daemon.config
        advice = (
            f'at {peer.name}, write public_key = "{encode_key(config.public_key)}" for {config.name}; if its key file'
            " was replaced, restart this daemon"
        )
        if peer.is_certified:
            advice = f"`uavlinkd fleet sign {peer.name}` prints a line for `uavlinkd enroll --finish` there"
        yield {"at": at(sighting), "advice": advice}


def other_version(peer: PeerFacts) -> Signs:
    """Which side to update: also if the message is forged, an update is safe."""
    if (sighting := peer.handshake_seen(DropReason.OTHER_VERSION)) is not None:
        seen = sorted(version for version in sighting.details if isinstance(version, int))
        older = [peer.name] if min(seen) < c.PROTOCOL_VERSION else []
        older += [f"{peer.daemon.config.name}, this machine"] if max(seen) > c.PROTOCOL_VERSION else []
        versions = " and ".join(f"uavlink/{version}" for version in seen)
        yield {"at": at(sighting), "versions": versions, "ours": c.PROTOCOL_VERSION, "older": " and at ".join(older)}


def wrong_psk(peer: PeerFacts) -> Signs:
    """Responses of the peer that this end refuses."""
    if (sighting := peer.seen(DropReason.BAD_HANDSHAKE)) is not None:
        yield {"sender": at(sighting)}


def no_common_suite(peer: PeerFacts) -> Signs:
    if (sighting := peer.seen(DropReason.SUITE_NOT_ACCEPTED)) is not None:
        accepted = ", ".join(suite.name for suite in peer.link.config.settings.link.suites)
        yield {"offered": ", ".join(map(str, sighting.details)), "accepted": accepted}


def no_listener(peer: PeerFacts) -> Signs:
    """It may be from before the peer started. A close explains it too."""
    if not peer.link.is_closed and (sighting := peer.seen(f"{REPORTED}ECONNREFUSED")) is not None:
        yield {"at": at(sighting)}


def not_confirmed(peer: PeerFacts) -> Signs:
    """The peer initiates, and has not confirmed the responses for :data:`CONFIRM_S`."""
    core = peer.link.peer
    since = core.received_at or -c.NEVER
    begun = [at for one in core.sessions.unconfirmed.values() if (at := one.session.created_at) > since]
    if begun and peer.now - min(begun) >= CONFIRM_S:
        yield {}


# Silence, without any other problem.


def closed_by_peer(peer: PeerFacts) -> Signs:
    if peer.is_overdue and peer.link.is_closed:
        yield {"age_s": peer.now - peer.link.closed_at}


def no_answer(peer: PeerFacts) -> Signs:
    """A silent peer that has a configured place, or was up before: then its address and keys were right."""
    config, was_up = peer.link.config, peer.link.peer.received_at is not None
    if not peer.is_overdue or not (was_up or config.addresses or config.relays):
        return
    bound = [name for name, relay in peer.daemon.relay_links.items() if relay.state_for(peer.link) == "bound"]
    via = f" through the {titled('relay', bound[0])}, which answers" if bound else ""
    places = f"it any more{via}" if was_up else peer.addresses or f"it{via}"
    causes = "it is off, or has no network" if bound else "it is off, out of range, or a firewall drops UDP"
    if peer.is_certified and not bound:
        causes += "; or it has a bulletin that revokes this daemon (on the laptop: `uavlinkd fleet list`)"
    elif not was_up and not peer.is_certified:
        causes += "; or addresses, keys, PSKs or protocol versions differ"
    start = f"start {peer.name}, and open its firewall; `uavlinkd status` there names other causes"
    radio = "; of a serial radio, compare the baud rate, NETID and air speed of both modems, and set MAVLINK=0"
    advice = (COMES_BACK if was_up else start) + ("" if peer.daemon.serial is None else radio)
    yield {"places": places, "causes": causes, "advice": advice}


def not_connecting(peer: PeerFacts) -> Signs:
    config = peer.link.config
    is_passive = not config.addresses and not config.relays and peer.link.peer.received_at is None
    if peer.is_overdue and is_passive:
        yield {}
