"""Why frames do not pass: the problems of the daemon, and the findings of a moment.

The problems of peers and endpoints are in :mod:`.down_problems` and :mod:`.traffic_problems`. Findings are computed
once a second and when a client asks for the status. Frames cost nothing here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Final

from uavlinkd.config.keys import encode_key
from uavlinkd.core.drops import DropReason
from uavlinkd.core.path import RELAY_HOST
from uavlinkd.core.sessions import Twin
from uavlinkd.link import facts
from uavlinkd.link import traffic_problems as traffic
from uavlinkd.link.down_problems import down_problems, is_deaf, relay_warnings, silence, versions
from uavlinkd.link.evidence import ELSEWHERE, EVIDENCE_S
from uavlinkd.link.facts import EndpointFacts, Found, Moment, PeerFacts, details_at, fault, listed, security, warning
from uavlinkd.link.fleet_problems import fleet_problems, pinned_problems
from uavlinkd.link.parts import DaemonParts
from uavlinkd.link.peer_link import LOSSES, PeerLink
from uavlinkd.link.serial_networks import RECENT_S
from uavlinkd.link.switch import Port
from uavlinkd.ops.findings import Finding, Subject
from uavlinkd.ops.log import shown
from uavlinkd.relay.service import RelayMember

LOAD: Final = 50
"""Refused handshake messages within :data:`EVIDENCE_S` that are reported."""


def daemon_problems(moment: Moment) -> Iterator[Found]:
    """Keys and addresses of this machine, networks that are absent, and the process."""
    daemon, now, evidence = moment.daemon, moment.now, moment.daemon.evidence
    stolen = evidence.own_key_elsewhere
    if stolen is not None and now - stolen[0] <= traffic.SECURITY_S:
        at = "an unknown address" if stolen[1] is None else shown(stolen[1])
        yield security(
            "own_key_elsewhere",
            f"a sender at {at} uses this daemon's private key, or an attacker replays an old recording",
            "if a card was copied, run `uavlinkd keygen` on one machine; else the key may be stolen: replace it",
        )
    if names := [name for name, peer in daemon.node.peers.items() if traffic.has_twin(peer, Twin.OURS, now)]:
        names = [name.removeprefix(RELAY_HOST) for name in names]
        yield traffic.two_machines(f"this daemon's private key: {listed(names)} states a session with another one")
    fault_if_down = fault if moment.down else warning
    if absent := daemon.peer_sockets.absent_addresses():
        yield fault_if_down(
            "listen_address_missing",
            f"no interface has {listed(map(str, absent))}, which is in listen",
            f"write an address of this machine (`ip -brief address`) or {absent[0].wildcard()}; or wait for the"
            " network",
        )
    if gone := daemon.peer_sockets.absent_networks():
        text = f"no peer is reached along {'; '.join(gone)}"
        yield fault_if_down("network_absent", text, "; ".join(dict.fromkeys(gone.values())))
    sighting = evidence.seen_at(DropReason.OTHER_VERSION, ELSEWHERE, now)
    if sighting is not None and moment.down and not moment.has_sole_waiting:
        there = "the sender" if len(moment.down) > 1 else moment.down[0].name
        yield versions(sighting, daemon.config.name, there)
    raw = evidence.seen_anywhere(DropReason.RAW_MAVLINK, now)
    if raw is not None and raw.address is not None:
        yield warning(
            "raw_mavlink",
            f"bare MAVLink arrives from {shown(raw.address)} at the port for peers, and is dropped",
            "let the autopilot or ground station send to the port of an [[endpoint]]",
        )
    reasons = (DropReason.COOKIE_REQUIRED, DropReason.RATE_LIMITED)
    seen = (evidence.seen_anywhere(reason, now) for reason in reasons)
    refused = sum(sighting.count for sighting in seen if sighting is not None)
    if refused >= LOAD:
        yield warning(
            "under_load",
            f"{refused:,} handshake messages came faster than the daemon accepts them: a flood may delay new links",
            "find the sender with `sudo tcpdump -ni any udp`; never block a peer's address: a sender can forge it."
            " Links that are up go on",
        )
    guard = daemon.guard
    if guard.faults and now - guard.last_at <= traffic.SECURITY_S:
        places = listed(f"{place} ({count}x)" for place, count in guard.faults.most_common())
        yield warning(
            "fault_inside",
            f"the daemon caught faults of its own: {places}",
            "send what `uavlinkd status --json` prints, and the log, to the developers; frames pass meanwhile",
        )
    full = evidence.seen_anywhere("ENOBUFS", now)
    if full is not None and full.count >= LOSSES:
        yield warning(
            "network_full",
            f"{full.count:,} times there was no room for datagrams, the last time to {facts.at(full)}: more is sent"
            " than the network, or the connection by TLS, carries",
            "lower the message rates of the clients, or end a log download",
        )
    paused = daemon.history.paused
    if paused is not None and now - paused[0] <= EVIDENCE_S:
        yield warning(
            "daemon_paused",
            f"the daemon was paused for {paused[1]:.1f} s, and dropped frames from that time",
            "give the daemon more CPU time (`uptime`), or do not suspend the machine",
        )
    if problems := daemon.history.refused_file:
        yield warning(
            "configuration_refused",
            f"the last reload was refused, and the configuration before is in force: {listed(problems, 1)}",
            f"correct what `uavlinkd check --config {daemon.config.path}` prints, and run `uavlinkd reload`",
        )
    yield from _circles(moment)


def _circles(moment: Moment) -> Iterator[Found]:
    """Ports from which frames come back that this daemon sent elsewhere."""
    for port, circle in moment.daemon.switch.router.sendings.circles.items():
        if moment.now - circle.returned_at <= EVIDENCE_S and (len(circle.systems) > 1 or circle.is_suspected):
            ways = " or ".join(sorted(map(_described, circle.through - {port}))) or "it"
            yield warning(
                "frames_in_circle",
                f"frames that went to {ways} came back from {_described(port)}, and are dropped: a client, a bridge"
                " or a radio joins both, or a sender there repeats equal frames",
                "let what joins them no longer forward from one to the other; give each sender its own system id",
            )


def _described(port: Port) -> str:
    return port.name if isinstance(port, PeerLink) else f"{port.endpoint.name} ({port.name})"


def member_problems(moment: Moment) -> Iterator[Found]:
    """Senders that may be members of the relay of this daemon."""
    daemon, now = moment.daemon, moment.now
    if daemon.relay is None:
        return
    members = [one for one in daemon.relay.members.values() if one.is_own]
    if deaf := [one for one in members if is_deaf(one.peer, now)]:
        yield warning(
            "member_not_confirmed",
            f"initiations of {listed(map(_initiator, deaf))} arrive, and it does not confirm the responses of this"
            " relay: these do not reach it, the PSKs differ, or an attacker replays old initiations",
            "let UDP from this relay through the firewalls here, there and between; compare the PSKs",
        )
    if twins := [one for one in members if traffic.has_twin(one.peer, Twin.PEERS, now)]:
        facts = (f"{one.settings.name}, from {traffic.places(one.peer)}" for one in twins)
        yield traffic.two_machines(f"the private key of a member: {listed(facts)}")
    unknown = daemon.evidence.seen_at(DropReason.UNKNOWN_PEER, ELSEWHERE, now)
    if unknown is not None and daemon.fleet is None:
        yield warning(
            "not_a_member",
            f"a sender has a key of no [[member]] here: {details_at(unknown.details)}",
            "if it is yours, run `uavlinkd pubkey` there, write into its [[member]] what that prints, and run"
            " `uavlinkd reload` here: a key that arrives proves nothing",
        )
    other = daemon.evidence.seen_at(DropReason.BAD_MAC1, ELSEWHERE, now)
    if (
        other is not None
        and other.address is not None
        and any(not member.peer.is_up for member in daemon.relay.members.values())
    ):
        yield warning(
            "other_relay_key",
            f"a sender at {shown(other.address)} has another public key for this relay",
            "compare the [[relay]] of each member that is down: public_key ="
            f' "{encode_key(daemon.config.public_key)}"',
        )


def _initiator(member: RelayMember) -> str:
    """A member, and where its last initiation came from that it has not confirmed."""
    waiting = list(member.peer.sessions.unconfirmed.values())
    return f"{member.settings.name} at {shown(waiting[-1].paths[0].address)}"


def line_problems(moment: Moment) -> Iterator[Found]:
    """What the modems of serial networks do to datagrams."""
    for network in moment.daemon.peer_sockets.serial.networks:
        if reports := network.recent_reports:
            yield warning(
                "modem_reports",
                f"on the serial network {network.name}, the modem sent {reports} RADIO_STATUS in {RECENT_S} s: it"
                " takes the line for MAVLink, and may cut datagrams",
                "set MAVLINK=0 on both modems: with mavproxy's or Mission Planner's radio settings, or by ATS6=0,"
                " AT&W and ATZ on a SiK modem",
            )
        if (noise := network.recent_noise) is not None:
            damaged, whole = noise
            yield warning(
                "line_noise",
                f"on the serial network {network.name}, {damaged} of {damaged + whole} pieces of the last {RECENT_S}"
                " s are damaged",
                f"compare the baud rate ({network.line.url.baud} here) with the modem's; set MAVLINK=0 on both SiK"
                " modems; let no other process and no autopilot use the line; else the radio is at its limit",
            )
        if (carried := network.carried_bits_s(moment.now)) is not None:
            yield warning(
                "radio_slow",
                f"answers come late over the serial network {network.name}: its radio carries about"
                f" {round(carried, -2):,.0f} bits/s, both directions together, and air_bits_s is"
                f" {network.config.air_bits_s:,}",
                f"write air_bits_s = {round(carried, -2):.0f} at both ends, unless the radio carries more nearby",
            )


def find(daemon: DaemonParts, now: float) -> list[Finding]:
    """All present findings: security first, then faults, then warnings; by subject and name among equals.

    Those of a peer keep their order: what is certain, then what arrives from its address, then ICMP messages.
    """
    moment = Moment(daemon, now)
    findings: list[Finding] = []

    def add(subject: Subject, name: str, problems: Iterable[Found]) -> None:
        for severity, cause, text, remedy in problems:
            findings.append(Finding(cause, severity, subject, name, text, remedy))

    of_daemon = (daemon_problems, fleet_problems, relay_warnings, member_problems, line_problems)
    add(Subject.DAEMON, "", chain.from_iterable(problems(moment) for problems in of_daemon))
    for link in daemon.links.values():
        peer = PeerFacts(moment, link)
        add(Subject.PEER, link.name, chain(traffic.peer_problems(peer), pinned_problems(peer)))
        if link.peer.is_up:
            add(Subject.PEER, link.name, traffic.up_problems(peer))
        else:
            add(Subject.PEER, link.name, list(down_problems(peer)) or silence(peer))
    configs = {config.name: config for config in daemon.config.endpoints}
    for endpoint in daemon.local.endpoints:
        if (config := configs.get(endpoint.name)) is not None:
            add(Subject.ENDPOINT, endpoint.name, traffic.endpoint_problems(EndpointFacts(moment, endpoint, config)))
    return sorted(findings, key=lambda one: (one.severity, one.subject, one.name))
