"""Why frames do not pass: findings from everything that this end sees.

Findings are computed once a second and when a client asks for the status. Frames cost nothing here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, Protocol

from uavlinkd.core.drops import DropReason
from uavlinkd.link import refused_there
from uavlinkd.link.down_causes import Network, finding, link_down, listed, sole_waiting
from uavlinkd.link.endpoint_causes import Local, endpoint_findings
from uavlinkd.link.evidence import EVIDENCE_S
from uavlinkd.link.line_causes import line_findings
from uavlinkd.link.member_causes import member_findings
from uavlinkd.link.other_version import other_version
from uavlinkd.link.passage import Key, Passage
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.shown import shown
from uavlinkd.link.system_owners import Switching, SystemOwners
from uavlinkd.link.traffic_causes import SECURITY_S, freshness, refusals, security
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.policy.refusal_totals import CODES
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Finding, Severity, Subject, ranked
from uavlinkd.ops.recorder import Recorder
from uavlinkd.relay.service import RelayService

LOAD: Final = 50
"""Refused handshake messages within :data:`EVIDENCE_S` that are reported."""


class Diagnosed(Network, Local, Switching, Protocol):
    """The parts of a daemon that findings are about."""

    passage: Passage
    relay: RelayService | None
    recorder: Recorder | None


def find(daemon: Diagnosed, now: float) -> list[Finding]:
    """All present findings, security first."""
    blocked = daemon.passage.blocked(daemon.links.values(), daemon.local.judged)
    return ranked([*_of_daemon(daemon, now), *_of_peers(daemon, blocked, now), *_of_endpoints(daemon, blocked, now)])


def _of_peers(daemon: Diagnosed, blocked: Sequence[Key], now: float) -> Iterator[Finding]:
    owners = SystemOwners(daemon)
    for link in daemon.links.values():
        yield from security(daemon, link, owners, now)
        if link.peer.is_up:
            yield from freshness(link, now)
            yield from refusals(daemon, link, blocked, owners, now)
        else:
            yield from link_down(daemon, link, now)
        yield from _refused_there(daemon, link, now)


def _refused_there(daemon: Diagnosed, link: PeerLink, now: float) -> Iterator[Finding]:
    """The peer's claim, under the peer's name."""
    if text := refused_there.describe(link, now):
        here, remedies = daemon.config.name, []
        foreign = {claim.refused.reason == CODES[Refusal.FOREIGN_SYSTEM] for claim in refused_there.recent(link, now)}
        if True in foreign:
            remedies.append(
                "set SYSID_THISMAV, MAV_SYSID or MAV_SYS_ID of the client here to an id in system_ids for"
                f" {here} in {link.name}'s file, or add the id there"
            )
        if False in foreign:
            remedies.append(f"if these frames are needed, change the role or lists of {here} in {link.name}'s file")
        yield finding(Cause.REFUSED_THERE, Subject.PEER, link.name, text, "; ".join(remedies))


def _of_endpoints(daemon: Diagnosed, blocked: Sequence[Key], now: float) -> Iterator[Finding]:
    configs = {config.name: config for config in daemon.config.endpoints}
    for endpoint in daemon.local.endpoints:
        if (config := configs.get(endpoint.name)) is not None:
            yield from endpoint_findings(daemon, endpoint, config, blocked, now)


def _of_daemon(daemon: Diagnosed, now: float) -> Iterator[Finding]:
    if (stolen := daemon.evidence.own_key_elsewhere) is not None and now - stolen[0] <= SECURITY_S:
        at = "an unknown address" if stolen[1] is None else shown(stolen[1])
        yield _about(
            Cause.OWN_KEY_ELSEWHERE,
            f"a sender at {at} uses this daemon's private key, or an attacker replays an old recording",
            "if a card was copied, run `uavlinkd keygen` on one machine; else the key may be stolen: replace it",
        )
    if absent := daemon.peer_sockets.absent_addresses():
        missing = _about(
            Cause.LISTEN_ADDRESS_MISSING,
            f"no interface has {listed(map(str, absent))}, which is in listen",
            'write an address of this machine (`ip -brief address`) or "0.0.0.0:5790"; or wait for the network',
        )
        yield _harmless_if_up(daemon, missing)
    if gone := daemon.peer_sockets.absent_networks():
        missing = _about(
            Cause.NETWORK_ABSENT,
            f"no peer is reached along {'; '.join(gone)}",
            "; ".join(dict.fromkeys(gone.values())),
        )
        yield _harmless_if_up(daemon, missing)
    if (raw := daemon.evidence.seen_anywhere(DropReason.RAW_MAVLINK, now)) is not None and raw.address is not None:
        yield _about(
            Cause.RAW_MAVLINK,
            f"bare MAVLink arrives from {shown(raw.address)} at the port for peers, and is dropped",
            "let the autopilot or ground station send to the port of an [[endpoint]]",
        )
    yield from line_findings(daemon.peer_sockets.serial)
    if daemon.relay is not None:
        yield from member_findings(daemon.relay, daemon.evidence, daemon.config.public_key, now)
    yield from _unnamed_version(daemon, now)
    if refused := _load(daemon, now):
        yield _about(
            Cause.UNDER_LOAD,
            f"{refused:,} handshake messages came faster than the daemon accepts them: a flood may delay new links",
            "find the sender with `sudo tcpdump -ni any udp`; never block a peer's address: a sender can forge it."
            " Links that are up go on",
        )
    paused = daemon.history.paused
    if paused is not None and now - paused[0] <= EVIDENCE_S:
        yield _about(
            Cause.DAEMON_PAUSED,
            f"the daemon was paused for {paused[1]:.1f} s, and dropped frames from that time",
            "give the daemon more CPU time (`uptime`), or do not suspend the machine",
        )
    recorder = daemon.recorder
    if recorder is not None and not recorder.is_recording:
        yield _about(
            Cause.RECORDING_STOPPED,
            f"no frame is recorded now ({listed(recorder.failures)})",
            "make room on its disk, and let the daemon's user write there",
        )


def _unnamed_version(daemon: Diagnosed, now: float) -> Iterator[Finding]:
    """Another version from an address of no peer, while it may be one of several peers that are down."""
    down = [link for link in daemon.links.values() if not link.peer.is_up]
    sighting = daemon.evidence.seen_elsewhere(DropReason.OTHER_VERSION, now)
    if sighting is not None and down and sole_waiting(daemon) is None:
        there = "the sender" if len(down) > 1 else down[0].name
        yield _about(Cause.OTHER_VERSION, *other_version(sighting, daemon.config.name, there))


def _harmless_if_up(daemon: Diagnosed, problem: Finding) -> Finding:
    """The same as a warning, if every peer is up all the same."""
    all_up = all(link.peer.is_up for link in daemon.links.values())
    return replace(problem, severity=Severity.WARNING) if all_up else problem


def _load(daemon: Diagnosed, now: float) -> int:
    """Handshake messages that were refused because there were too many; 0 below :data:`LOAD`."""
    reasons = (DropReason.COOKIE_REQUIRED, DropReason.RATE_LIMITED)
    seen = (daemon.evidence.seen_anywhere(reason, now) for reason in reasons)
    count = sum(sighting.count for sighting in seen if sighting is not None)
    return count if count >= LOAD else 0


def _about(cause: Cause, text: str, remedy: str) -> Finding:
    return finding(cause, Subject.DAEMON, "", text, remedy)
