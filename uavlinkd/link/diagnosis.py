"""Why frames do not pass: the problems of the daemon, and the findings of a moment.

The problems of peers and endpoints are in :mod:`.down_problems` and :mod:`.traffic_problems`. Findings are computed
once a second and when a client asks for the status. Frames cost nothing here.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from uavlinkd.config.keys import encode_key
from uavlinkd.core.drops import DropReason
from uavlinkd.link import down_problems as down
from uavlinkd.link import traffic_problems as traffic
from uavlinkd.link.evidence import EVIDENCE_S
from uavlinkd.link.facts import (
    OF_DAEMON,
    OF_ENDPOINT,
    OF_PEER,
    OF_PEER_DOWN,
    OF_PEER_SILENT,
    OF_PEER_UP,
    EndpointFacts,
    F,
    Found,
    Moment,
    PeerFacts,
    ProblemTable,
    listed,
)
from uavlinkd.link.parts import DaemonParts
from uavlinkd.link.serial_networks import RECENT_S
from uavlinkd.ops.findings import Finding, Severity, Subject
from uavlinkd.ops.log import shown

LOAD: Final = 50
"""Refused handshake messages within :data:`EVIDENCE_S` that are reported."""

# The daemon.


@OF_DAEMON.add(Severity.SECURITY)
def _own_key_elsewhere(moment: Moment) -> Iterator[Found]:
    stolen = moment.daemon.evidence.own_key_elsewhere
    if stolen is not None and moment.now - stolen[0] <= traffic.SECURITY_S:
        at = "an unknown address" if stolen[1] is None else shown(stolen[1])
        yield Found(
            f"a sender at {at} uses this daemon's private key, or an attacker replays an old recording",
            "if a card was copied, run `uavlinkd keygen` on one machine; else the key may be stolen: replace it",
        )


@OF_DAEMON.add(Severity.FAULT)
def _listen_address_missing(moment: Moment) -> Iterator[Found]:
    if absent := moment.daemon.peer_sockets.absent_addresses():
        yield Found(
            f"no interface has {listed(map(str, absent))}, which is in listen",
            'write an address of this machine (`ip -brief address`) or "0.0.0.0:5790"; or wait for the network',
            None if moment.down else Severity.WARNING,
        )


@OF_DAEMON.add(Severity.FAULT)
def _network_absent(moment: Moment) -> Iterator[Found]:
    if gone := moment.daemon.peer_sockets.absent_networks():
        remedies = "; ".join(dict.fromkeys(gone.values()))
        severity = None if moment.down else Severity.WARNING
        yield Found(f"no peer is reached along {'; '.join(gone)}", remedies, severity)


@OF_DAEMON.add(Severity.FAULT)
def _other_version(moment: Moment) -> Iterator[Found]:
    sighting = moment.daemon.evidence.seen_elsewhere(DropReason.OTHER_VERSION, moment.now)
    if sighting is not None and moment.down and moment.sole_waiting is None:
        there = "the sender" if len(moment.down) > 1 else moment.down[0].name
        yield down.versions(sighting, moment.daemon.config.name, there)


@OF_DAEMON.add(Severity.WARNING)
def _raw_mavlink(moment: Moment) -> Iterator[Found]:
    raw = moment.daemon.evidence.seen_anywhere(DropReason.RAW_MAVLINK, moment.now)
    if raw is not None and raw.address is not None:
        yield Found(
            f"bare MAVLink arrives from {shown(raw.address)} at the port for peers, and is dropped",
            "let the autopilot or ground station send to the port of an [[endpoint]]",
        )


@OF_DAEMON.add(Severity.WARNING)
def _not_a_member(moment: Moment) -> Iterator[Found]:
    daemon = moment.daemon
    unknown = daemon.evidence.seen_elsewhere(DropReason.UNKNOWN_PEER, moment.now)
    if daemon.relay is not None and unknown is not None and unknown.address is not None:
        keys = ", ".join(encode_key(key) for key in unknown.details if isinstance(key, bytes))
        yield Found(
            f"a sender at {shown(unknown.address)} has a key of no [[member]] here: {keys}",
            "if it is yours, run `uavlinkd pubkey` there, write into its [[member]] what that prints, and run"
            " `uavlinkd reload` here: a key that arrives proves nothing",
        )


@OF_DAEMON.add(Severity.WARNING)
def _other_relay_key(moment: Moment) -> Iterator[Found]:
    daemon = moment.daemon
    other = daemon.evidence.seen_elsewhere(DropReason.BAD_MAC1, moment.now)
    if daemon.relay is None or other is None or other.address is None:
        return
    if any(not member.peer.is_up for member in daemon.relay.members.values()):
        key = encode_key(daemon.config.public_key)
        yield Found(
            f"a sender at {shown(other.address)} has another public key for this relay",
            f'compare the [[relay]] of each member that is down: public_key = "{key}"',
        )


@OF_DAEMON.add(Severity.WARNING)
def _modem_reports(moment: Moment) -> Iterator[Found]:
    for network in moment.daemon.peer_sockets.serial.networks:
        if reports := network.recent_reports:
            yield Found(
                f"on the serial network {network.name}, the modem sent {reports} RADIO_STATUS in {RECENT_S} s: it"
                " takes the line for MAVLink, and may cut datagrams",
                "set MAVLINK=0 on both modems: with mavproxy's or Mission Planner's radio settings, or by ATS6=0,"
                " AT&W and ATZ on a SiK modem",
            )


@OF_DAEMON.add(Severity.WARNING)
def _line_noise(moment: Moment) -> Iterator[Found]:
    for network in moment.daemon.peer_sockets.serial.networks:
        if (noise := network.recent_noise) is not None:
            damaged, whole = noise
            yield Found(
                f"on the serial network {network.name}, {damaged} of {damaged + whole} pieces of the last {RECENT_S}"
                " s are damaged",
                f"compare the baud rate ({network.line.url.baud} here) with the modem's; set MAVLINK=0 on both SiK"
                " modems; let no other process and no autopilot use the line; else the radio is at its limit",
            )


@OF_DAEMON.add(Severity.WARNING)
def _under_load(moment: Moment) -> Iterator[Found]:
    reasons = (DropReason.COOKIE_REQUIRED, DropReason.RATE_LIMITED)
    seen = (moment.daemon.evidence.seen_anywhere(reason, moment.now) for reason in reasons)
    refused = sum(sighting.count for sighting in seen if sighting is not None)
    if refused >= LOAD:
        yield Found(
            f"{refused:,} handshake messages came faster than the daemon accepts them: a flood may delay new links",
            "find the sender with `sudo tcpdump -ni any udp`; never block a peer's address: a sender can forge it."
            " Links that are up go on",
        )


@OF_DAEMON.add(Severity.WARNING)
def _daemon_paused(moment: Moment) -> Iterator[Found]:
    paused = moment.daemon.history.paused
    if paused is not None and moment.now - paused[0] <= EVIDENCE_S:
        yield Found(
            f"the daemon was paused for {paused[1]:.1f} s, and dropped frames from that time",
            "give the daemon more CPU time (`uptime`), or do not suspend the machine",
        )


@OF_DAEMON.add(Severity.WARNING)
def _recording_stopped(moment: Moment) -> Iterator[Found]:
    recorder = moment.daemon.recorder
    if recorder is not None and not recorder.is_recording:
        yield Found(
            f"no frame is recorded now ({listed(recorder.failures)})",
            "make room on its disk, and let the daemon's user write there",
        )


def find(daemon: DaemonParts, now: float) -> list[Finding]:
    """All present findings: security first, then faults, then warnings; by subject and name among equals."""
    moment = Moment(daemon, now)
    findings = _about(Subject.DAEMON, "", OF_DAEMON, moment)
    for link in daemon.links.values():
        peer = PeerFacts(moment, link.name, daemon.history.peer(link.name), link.config.policy, link)
        findings += _about(Subject.PEER, link.name, OF_PEER, peer)
        if link.peer.is_up:
            findings += _about(Subject.PEER, link.name, OF_PEER_UP, peer)
        else:
            explained = _about(Subject.PEER, link.name, OF_PEER_DOWN, peer)
            findings += explained or _about(Subject.PEER, link.name, OF_PEER_SILENT, peer)
    configs = {config.name: config for config in daemon.config.endpoints}
    for endpoint in daemon.local.endpoints:
        if (config := configs.get(endpoint.name)) is not None:
            history = daemon.history.endpoint(endpoint.name)
            facts = EndpointFacts(moment, endpoint.name, history, config.policy, endpoint, config)
            findings += _about(Subject.ENDPOINT, endpoint.name, OF_ENDPOINT, facts)
    return sorted(findings, key=lambda one: (one.severity, one.subject, one.name, one.cause))


def _about(subject: Subject, name: str, problems: ProblemTable[F], facts: F) -> list[Finding]:
    found = [(row, one) for row in problems.rows for one in row.look(facts)]
    causes = {row.cause for row, _ in found}
    return [
        Finding(row.cause, row.severity if severity is None else severity, subject, name, text, remedy)
        for row, (text, remedy, severity) in found
        if causes.isdisjoint(row.unless)
    ]
