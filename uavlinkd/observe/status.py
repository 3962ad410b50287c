"""The status of a daemon: plain values for JSON, without secrets. ``web/metrics.py`` exports them by their keys."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

from uavlinkd import __version__
from uavlinkd.config.keys import encode_key
from uavlinkd.daemon.parts import DaemonParts
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.io.ports import Endpoint
from uavlinkd.mavlink.dialect import command_name, name_of
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import ANY_OTHER, REFUSALS, Refusal
from uavlinkd.observe.facts import is_contested, is_reached, proves_key
from uavlinkd.observe.finding import Finding
from uavlinkd.observe.findings import find, has_no_client, stop_frames
from uavlinkd.observe.observer import Observer
from uavlinkd.observe.traffic_signs import codes_there, name_of_problem, stops_frames
from uavlinkd.ops import LOG_SCHEMA, STATUS_SCHEMA
from uavlinkd.ops.log import shown
from uavlinkd.protocol.path import Path, SocketAddress, relay_name
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.peer import Peer
from uavlinkd.system.addresses import Address

if TYPE_CHECKING:
    from uavlinkd.fleet.members import FleetMembers
    from uavlinkd.relay.client_link import RelayLink
    from uavlinkd.relay.service import RelayMember, RelayService

WayOf = Callable[[Path], tuple[str | None, SocketAddress | None]]
"""The name of a path's network, if the configuration names any, and the relay's address along a relayed path."""
_STATM = FilePath("/proc/self/statm")


def overview(observer: Observer, now: float, detailed: Collection[str]) -> dict[str, object]:
    """The status with few facts of each peer, except of those that ``detailed`` names; findings are up to 4 s old.

    A page that 200 peers are on asks for it every second: the whole status would cost several percent of a core.
    """
    return _status(observer, now, observer.findings, detailed)


def daemon_status(observer: Observer, now: float) -> dict[str, object]:
    """The status of the whole daemon. Times are ages in seconds. A client computes rates from two of these.

    ``frames_pass``: every peer is up with a path that works, within the last 10 s no traffic was wholly refused
    (``blocked`` names it), clients are not all absent (``has_no_client``), and no two machines contend with one key
    for a link (``contested``). ``stopped_there``: peers that say so of themselves and send no telemetry; that is a
    claim, and health checks act on ``frames_pass``.
    """
    daemon = observer.parts
    status = _status(observer, now, find(daemon, observer.history, now), daemon.links)
    return status | {"process": _own_process() | {"uptime_s": now - daemon.started_at}}


def _own_process() -> dict[str, object]:
    resident_bytes = None
    with suppress(OSError):  # as on other systems than Linux
        resident_bytes = int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return {
        "version": __version__,
        "python": platform.python_version(),
        "log_schema": LOG_SCHEMA,
        "cpu_s": time.process_time(),
        "resident_bytes": resident_bytes,
    }


def _status(
    observer: Observer, now: float, findings: Sequence[Finding], detailed: Collection[str]
) -> dict[str, object]:
    daemon, node = observer.parts, observer.parts.node
    blocked = observer.history.blocked(now)
    is_cut_off = has_no_client(findings, daemon.local.endpoints)
    contested = [name for name, link in daemon.links.items() if is_contested(link.peer, now)]
    all_up = (bool(daemon.links) or daemon.config.is_only_relay) and all(
        is_reached(daemon, link.peer, now) for link in daemon.links.values()
    )
    return {
        "schema": STATUS_SCHEMA,
        "name": daemon.config.name,
        "public_key": encode_key(node.public_key),
        "monotonic_s": now,
        "frames_pass": all_up and not (stop_frames(findings) or is_cut_off or contested),
        "blocked": [dict(zip(("subject", "name", "direction"), key, strict=True)) for key in blocked],
        "has_no_client": is_cut_off,
        "contested": contested,
        "stopped_there": [name for name, link in daemon.links.items() if stops_frames(link, now)],
        "findings": [finding.as_json() for finding in findings],
        "peers": {
            name: (peer_status if name in detailed else _few_facts)(link, daemon, now)
            for name, link in daemon.links.items()
        },
        "relays": {name: used_relay_status(relay, daemon, now) for name, relay in daemon.relay_links.items()},
        "fleet": None if daemon.fleet is None else fleet_status(daemon.fleet, daemon.links, now),
        "networks": daemon.peer_sockets.network_status(),
        "endpoints": {
            endpoint.name: endpoint_status(endpoint, daemon.local.policies[endpoint.name], now)
            for endpoint in daemon.local.endpoints
        },
        "drops": _counts(node.drops),
        "faults": dict(daemon.guard.faults),
        "stale": dict(daemon.stall.dropped),
        "unrouted": _counts(daemon.switch.router.unrouted),
        "send_failures": dict(daemon.peer_sockets.failures),
        "relay": None
        if (relay := daemon.relay) is None
        else {
            "members": {one.settings.name: _member_status(relay, one, now) for one in relay.members.values()},
            "connections": relay.bindings.connections,
            "https": None if (listener := daemon.listener) is None else listener.status(),
            "dropped": _counts(relay.forwarding.dropped),
        },
    }


def _counts(counts: Mapping[Any, int]) -> dict[str, int]:
    return {reason.value: count for reason, count in counts.items()}


def _age(at: float | None, now: float) -> float | None:
    return None if at is None else now - at


def fleet_status(fleet: FleetMembers, links: Mapping[str, PeerLink], now: float) -> dict[str, object]:
    """What a daemon knows of its fleet. ``events``: their age in seconds. ``bulletins``: the number that each peer
    stated. ``absent``: the keys of members that have not come since the start.
    """
    from uavlinkd.authority.enrolment import fingerprint_of  # noqa: PLC0415  only if configured

    trust = fleet.trust
    own = None if trust.own is None else trust.own.certificate
    return {
        "fleet": fingerprint_of(fleet.config.authority.public),
        "name": own and own.name,
        "role": own and own.role.name.lower(),
        "serial": own and own.serial,
        "is_revoked": own is not None and trust.bulletin.refuses(own.serial),
        "number": trust.bulletin.number,
        "least": trust.bulletin.least,
        "revoked": list(trust.bulletin.revoked),
        "absent": {name: encode_key(key) for name, key in fleet.absent.items()},
        "held": {held.certificate.name: held.certificate.serial for held in trust.held.values()},
        "bulletins": {name: fleet.exchange.shown(link.key) for name, link in links.items()},
        "problem": fleet.problem,
        "events": {name: now - at for name, (at, _) in fleet.noticed(now).items()},
    }


def _few_facts(link: PeerLink, daemon: DaemonParts, now: float) -> dict[str, object]:
    """What a table of peers shows."""
    way_of = daemon.peer_sockets.way_of
    paths = [_path_now(link, state, way_of, now) for state in _best_first(link)]
    return _peer_now(link, daemon, now) | {"paths": paths}


def _peer_now(link: PeerLink, daemon: DaemonParts, now: float) -> dict[str, object]:
    peer, figures, (bytes_in_s, bytes_out_s) = link.peer, link.figures, link.rates.of(link.peer)
    return {
        "state": state_of(daemon, peer, now),
        "path": None if peer.path is None else shown(peer.path.address),
        "last_received_s": _age(peer.received_at, now),
        "freshness_unverified_s": _age(peer.unverified_since, now),
        "role": link.config.policy.get("role"),
        "commands": {"in": link.policy.incoming.passes_commands, "out": link.policy.outgoing.passes_commands},
        "vehicles": link.vehicles.status(now),
        "round_trip_s": link.round_trip_s,
        "loss_in": figures.loss_in,
        "loss_out": figures.loss_out,
        "bytes_in_s": bytes_in_s,
        "bytes_out_s": bytes_out_s,
    }


def peer_status(link: PeerLink, daemon: DaemonParts, now: float) -> dict[str, object]:
    """The status of a peer."""
    peer = link.peer
    session = peer.sessions.current
    traffic, totals = peer.traffic, peer.paths.totals
    return _peer_now(link, daemon, now) | {
        "public_key": encode_key(peer.settings.public_key),
        "handshake_s": _age(peer.established_at, now),
        "paths": paths_status(link, daemon.peer_sockets.way_of, now),
        "session": None
        if session is None
        else {
            "generation": session.parameters.generation,
            "suite": session.suite.name,
            "mode": "confidential" if session.parameters.confidential else "authenticated",
            "tag_bits": 8 * session.tag_bytes,
            "sent": session.send_counter,
            "received": session.received,
            "lost_in": session.expected - session.received,
        },
        "handshakes": traffic.handshakes,
        "envelopes_sent": peer.envelopes_sent,
        "envelopes_received": peer.envelopes_received,
        "bytes_sent": totals.bytes_sent,
        "bytes_elsewhere": traffic.bytes_elsewhere,
        "bytes_received": totals.bytes_received,
        **{problem.value: count for problem, count in link.problems(now).items()},
        "frames_sent": link.frames_sent,
        "frames_received": link.counters.frames,
        "frames_unknown": link.counters.unknown,
        "frames_superseded": link.frames_superseded,
        "malformed": _counts(link.counters.faults),
        **_refusals(link.policy),
        "refused_there": _claims(link, now),
        "problems_there": [name_of_problem(code) for code in codes_there(peer, now)],
        "waiting_dropped": {} if link.pacer.egress is None else _counts(link.pacer.egress.totals),
        "repair": {
            "is_on": link.pacer.repair.is_on,
            "on_s": now - link.pacer.repair.began_at if link.pacer.repair.is_on else 0.0,
            "transmissions": link.pacer.repair.transmissions,
            "datagrams": link.pacer.copies.repeats_sent,
            "bytes": link.pacer.copies.repeat_bytes,
        },
        "copies_dropped": _counts(link.pacer.copies.dropped),
        "drops": _counts(traffic.drops),
    }


def _claims(link: PeerLink, now: float) -> list[dict[str, object]]:
    """What the peer reports to refuse: every claim that this end remembers, the latest first."""
    return [
        {
            "message": name_of(claim.refused.message),
            "command": command_name(claim.refused.command) if claim.refused.command else None,
            "reason": REFUSALS.get(claim.refused.reason, f"reason_{claim.refused.reason}"),
            "count": claim.refused.total,
            "last_s": now - claim.changed_at,
        }
        for claim in link.peer.claims.refusals()
    ]


def state_of(daemon: DaemonParts, peer: Peer, now: float) -> str:
    """``up``, ``lost`` (was up) or ``waiting`` (was never up)."""
    return "up" if is_reached(daemon, peer, now) else "lost" if peer.received_at is not None else "waiting"


def used_relay_status(relay: RelayLink, daemon: DaemonParts, now: float) -> dict[str, object]:
    """The status of a relay. ``peer``: the peer that it is too, or None. ``peers``: those that use it, each with
    ``bound``, ``waiting`` for the peer to ask too, or ``unanswered``. ``seen_as``: this daemon's addresses as the
    relay sees them, along the paths that work now. ``tls``: by URL whether there is a connection, or why not.
    """
    peer = relay.peer
    return {
        "state": state_of(daemon, peer, now),
        "peer": relay.config.peer,
        "public_key": encode_key(peer.settings.public_key),
        "addresses": [str(written) for written in relay.config.addresses],
        "tls": {} if daemon.tls is None else daemon.tls.states(relay.config.addresses),
        "seen_as": [str(seen) for path, seen in relay.views() if relay.works_along(path)],
        "last_received_s": _age(peer.received_at, now),
        "handshake_s": _age(peer.established_at, now),
        "round_trip_s": peer.round_trip_s,
        "paths": paths_status(relay, daemon.peer_sockets.way_of, now),
        "peers": {
            link.name: relay.state_for(link)
            for link in daemon.links.values()
            if relay.config.name in link.config.relays
        },
        "bytes_received": peer.paths.totals.bytes_received,
        "bytes_sent": peer.paths.totals.bytes_sent,
        "drops": _counts(peer.traffic.drops),
    }


def endpoint_status(endpoint: Endpoint, policy: Policy, now: float) -> dict[str, object]:
    """The status of a local endpoint and its clients. ``signing``: whether its autopilot proves the key now."""
    return {
        "clients": {port.name: {"last_received_s": _age(port.received_at, now)} for port in endpoint.ports},
        "frames_received": endpoint.counters.frames,
        "frames_unknown": endpoint.counters.unknown,
        "frames_sent": endpoint.frames_sent,
        "bytes_received": endpoint.bytes_received,
        "bytes_sent": endpoint.bytes_sent,
        "garbage_bytes": endpoint.counters.garbage_bytes,
        "faults": _counts(endpoint.counters.faults),
        "failures": dict(endpoint.failures),
        "signing": None
        if (signing := endpoint.signing) is None
        else {"is_verified": proves_key(signing, now), "link_id": signing.link_id},
        **_refusals(policy),
    }


def _refusals(policy: Policy) -> dict[str, object]:
    """Refused frames by direction, message and reason; COMMAND_LONG and COMMAND_INT also by command."""
    messages, commands = {}, {}
    for direction, gate in (("in", policy.incoming), ("out", policy.outgoing)):
        messages[direction] = _by_name(name_of, gate.refused.items())
        commands[direction] = _by_name(
            command_name, ((key[1:], count) for key, count in gate.refused_commands.items())
        )
    return {"refused": messages, "refused_commands": commands}


def _by_name(
    name_of_number: Callable[[int], str], counts: Iterable[tuple[tuple[int, Refusal], int]]
) -> dict[str, dict[str, int]]:
    named: dict[str, dict[str, int]] = {}
    for (number, refusal), count in counts:
        reasons = named.setdefault("others" if number == ANY_OTHER else name_of_number(number), {})
        reasons[refusal.value] = reasons.get(refusal.value, 0) + count
    return named


def _member_status(relay: RelayService, member: RelayMember, now: float) -> dict[str, object]:
    peer, meter = member.peer, member.meter
    bound, waiting = relay.bindings.peers_of(member.key)
    return {
        "public_key": encode_key(member.key),
        "is_up": peer.is_up,
        "since_s": now - member.since,
        "addresses": [str(Address.of(state.path.address)) for state in peer.paths.states if state.is_validated],
        "bound": bound,
        "waiting": waiting,
        "binds_ignored": member.binds_ignored + relay.bindings.refused(member.key),
        "datagrams": meter.datagrams,
        "bytes": meter.bytes,
        "over_limit": meter.over_limit,
    }


def paths_status(link: PeerLink | RelayLink, way_of: WayOf, now: float) -> list[dict[str, object]]:
    """Each path to a peer, the best first, then the configured ones.

    ``carries`` has the classes of frames that go along it now. Losses are shares of recent datagrams.
    ``number`` stays the same as long as the path is known, and is below 256. ``relay`` is the one through which it
    leads, and ``relay_address`` where it is reached; null for a direct path.
    """
    return [_path_status(link, state, way_of, now) for state in _best_first(link)]


def _best_first(link: PeerLink | RelayLink) -> list[PathState]:
    paths = link.peer.paths
    return sorted(paths.states, key=lambda state: state is not paths.best)


def _path_now(link: PeerLink | RelayLink, state: PathState, way_of: WayOf, now: float) -> dict[str, object]:
    bytes_in_s, bytes_out_s = link.rates.of(state)
    return {
        "number": state.number,
        "network": way_of(state.path)[0],
        "address": shown(state.path.address),
        "relay": relay_name(state.path.address),
        "state": state.condition.value,
        "reason": state.reason,
        "role": link.peer.paths.role(state),
        "answered_s": now - state.answered_at if state.is_validated else None,
        "round_trip_s": state.srtt_s,
        "loss_in": state.loss_in,
        "loss_out": state.loss_out,
        "bytes_in_s": bytes_in_s,
        "bytes_out_s": bytes_out_s,
    }


def _path_status(link: PeerLink | RelayLink, state: PathState, way_of: WayOf, now: float) -> dict[str, object]:
    peer = link.peer
    relay_address = way_of(state.path)[1]
    return _path_now(link, state, way_of, now) | {
        "relay_address": None if relay_address is None else str(Address.of(relay_address)),
        "envelope_bytes": state.envelope_limit.limit,
        "is_configured": state.is_configured,
        "carries": [cls.value for cls, route in peer.paths.routes.items() if peer.is_up and state in route],
        "jitter_s": state.rttvar_s,
        "bytes_received": state.bytes_received,
        "bytes_sent": state.bytes_sent,
        "datagrams_received": state.datagrams_received,
        "datagrams_sent": state.datagrams_sent,
        "duplicates": state.duplicates,
    }
