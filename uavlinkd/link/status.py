"""The status of a daemon: plain values for JSON, without secrets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from uavlinkd.config.keys import encode_key
from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.link import refused_there
from uavlinkd.link.diagnosis import find
from uavlinkd.link.path_status import NetworkOf, RelayAddressOf, paths_status
from uavlinkd.link.relay_server_status import relay_status
from uavlinkd.link.shown import shown
from uavlinkd.mavlink.dialect import command_name, name_of
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import ANY_OTHER
from uavlinkd.ops.schema_versions import STATUS_SCHEMA

if TYPE_CHECKING:
    from collections.abc import Iterable

    from uavlinkd.config import Config
    from uavlinkd.core.node import Node
    from uavlinkd.core.peer import Peer
    from uavlinkd.link.evidence import Evidence
    from uavlinkd.link.history import History
    from uavlinkd.link.local_endpoints import LocalEndpoints
    from uavlinkd.link.passage import Passage
    from uavlinkd.link.peer_link import PeerLink
    from uavlinkd.link.peer_sockets import PeerSockets
    from uavlinkd.link.relay_link import RelayLink
    from uavlinkd.link.relays import Relays
    from uavlinkd.link.switch import Switch
    from uavlinkd.ops.recorder import Recorder
    from uavlinkd.relay.service import RelayService
    from uavlinkd.system.stall import StallWatch


class DaemonParts(Protocol):
    """The parts of a daemon that its status describes."""

    config: Config
    node: Node
    evidence: Evidence
    history: History
    passage: Passage
    links: dict[str, PeerLink]
    local: LocalEndpoints
    switch: Switch
    relays: Relays
    peer_sockets: PeerSockets
    stall: StallWatch
    recorder: Recorder | None
    relay: RelayService | None


def daemon_status(daemon: DaemonParts, now: float) -> dict[str, object]:
    """The status of the whole daemon. Times are ages in seconds. A client computes rates from two of these.

    ``frames_pass``: every peer is up, and within the last 10 s no traffic was wholly refused. ``blocked`` names it.
    """
    node = daemon.node
    blocked = daemon.passage.blocked(daemon.links.values(), daemon.local.judged)
    all_up = (bool(daemon.links) or daemon.config.is_only_relay) and all(
        link.peer.is_up for link in daemon.links.values()
    )
    return {
        "schema": STATUS_SCHEMA,
        "name": daemon.config.name,
        "public_key": encode_key(node.public_key),
        "monotonic_s": now,
        "frames_pass": all_up and not blocked,
        "blocked": [dict(zip(("subject", "name", "direction"), key, strict=True)) for key in blocked],
        "findings": [finding.as_json() for finding in find(daemon, now)],
        "peers": {
            name: peer_status(link, now, daemon.peer_sockets.network_name, daemon.relays.handles.address_of)
            for name, link in daemon.links.items()
        },
        "relays": {
            name: used_relay_status(relay, daemon.links.values(), now, daemon.peer_sockets.network_name)
            for name, relay in daemon.relays.by_name.items()
        },
        "networks": daemon.peer_sockets.network_status(now),
        "endpoints": {
            endpoint.name: endpoint_status(endpoint, daemon.local.policies[endpoint.name], now)
            for endpoint in daemon.local.endpoints
        },
        "drops": {reason.value: count for reason, count in node.drops.items()},
        "stale": dict(daemon.stall.dropped),
        "unrouted": {reason.value: count for reason, count in daemon.switch.router.unrouted.items()},
        "send_failures": dict(daemon.peer_sockets.failures),
        "relay": None if daemon.relay is None else relay_status(daemon.relay, now),
        "recording": None if daemon.recorder is None else recording_status(daemon.recorder),
    }


def peer_status(
    link: PeerLink,
    now: float,
    network_of: NetworkOf = lambda _: None,
    relay_address_of: RelayAddressOf = lambda _: None,
) -> dict[str, object]:
    """The status of a peer. ``state`` is ``up``, ``lost`` (was up) or ``waiting`` (was never up).

    ``network_of`` returns the name of the network of a socket's number, ``relay_address_of`` the address of the relay
    along a relayed path.
    """
    peer, figures = link.peer, link.figures
    session = peer.sessions.current
    traffic = peer.traffic
    expected_there, received_there = traffic.reported
    return {
        "state": state_of(peer),
        "public_key": encode_key(peer.settings.public_key),
        "accepts_previous_key": link.accepts_previous_keys,
        "path": None if peer.path is None else shown(peer.path.address),
        "last_received_s": None if peer.received_at is None else now - peer.received_at,
        "handshake_s": None if peer.established_at is None else now - peer.established_at,
        "round_trip_s": link.round_trip_s,
        "freshness_unverified_s": None if peer.unverified_since is None else now - peer.unverified_since,
        "loss_in": figures.loss_in,
        "loss_out": figures.loss_out,
        "bytes_in_s": link.bytes_s[0],
        "bytes_out_s": link.bytes_s[1],
        "paths": paths_status(link, network_of, now, relay_address_of),
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
            "lost_out": expected_there - received_there,
        },
        "handshakes": traffic.handshakes,
        "envelopes_sent": traffic.envelopes_sent,
        "envelopes_received": traffic.envelopes_received,
        "bytes_sent": traffic.bytes_sent,
        "bytes_elsewhere": traffic.bytes_elsewhere,
        "bytes_received": traffic.bytes_received,
        **{problem.value: count for problem, count in link.problems(now).items()},
        "role": link.config.policy.get("role"),
        "frames_sent": link.frames_sent,
        "frames_received": link.counters.frames,
        "frames_unknown": link.counters.unknown,
        "frames_superseded": link.frames_superseded,
        "malformed": {fault.value: count for fault, count in link.counters.faults.items()},
        "refused": policy_status(link.policy),
        "refused_commands": commands_status(link.policy),
        "refused_there": refused_there.as_json(link, now),
        "waiting_dropped": {}
        if link.output.egress is None
        else {reason.value: count for reason, count in link.output.egress.totals.items()},
        "repair": {
            "is_on": link.output.repair.is_on,
            "on_s": 0.0 if link.output.repair.began_at is None else now - link.output.repair.began_at,
            "transmissions": link.output.repair.transmissions,
            "datagrams": link.output.repeats.sent,
            "bytes": link.output.repeats.bytes_sent,
        },
        "copies_dropped": {reason.value: count for reason, count in link.output.copies.dropped.items()},
        "drops": {reason.value: count for reason, count in traffic.drops.items()},
    }


def state_of(peer: Peer) -> str:
    """``up``, ``lost`` (was up) or ``waiting`` (was never up)."""
    return "up" if peer.is_up else "lost" if peer.received_at is not None else "waiting"


def used_relay_status(
    relay: RelayLink, links: Iterable[PeerLink], now: float, network_of: NetworkOf = lambda _: None
) -> dict[str, object]:
    """The status of a relay. ``peer``: the peer that it is too, or None. ``peers``: those that use it, each with
    ``bound``, ``waiting`` for the peer to ask too, or ``unanswered``. ``seen_as``: this daemon's addresses as the
    relay sees them.
    """
    peer = relay.peer
    return {
        "state": state_of(peer),
        "peer": relay.config.peer,
        "public_key": encode_key(peer.settings.public_key),
        "addresses": [str(written) for written in relay.addresses],
        "seen_as": [str(address) for address in relay.seen_as],
        "last_received_s": None if peer.received_at is None else now - peer.received_at,
        "handshake_s": None if peer.established_at is None else now - peer.established_at,
        "round_trip_s": peer.round_trip_s,
        "paths": paths_status(relay, network_of, now),
        "peers": {link.name: relay.state_for(link) for link in links if relay.config.name in link.config.relays},
        "bytes_received": peer.traffic.bytes_received,
        "bytes_sent": peer.traffic.bytes_sent,
        "drops": {reason.value: count for reason, count in peer.traffic.drops.items()},
    }


def endpoint_status(endpoint: Endpoint, policy: Policy, now: float) -> dict[str, object]:
    """The status of a local endpoint and its clients."""
    return {
        "clients": {
            port.name: {"last_received_s": None if port.received_at is None else now - port.received_at}
            for port in endpoint.ports
        },
        "frames_received": endpoint.counters.frames,
        "frames_unknown": endpoint.counters.unknown,
        "frames_sent": endpoint.frames_sent,
        "bytes_received": endpoint.bytes_received,
        "bytes_sent": endpoint.bytes_sent,
        "garbage_bytes": endpoint.counters.garbage_bytes,
        "faults": {fault.value: count for fault, count in endpoint.counters.faults.items()},
        "failures": dict(endpoint.failures),
        "refused": policy_status(policy),
        "refused_commands": commands_status(policy),
    }


def recording_status(recorder: Recorder) -> dict[str, object]:
    """The counts of recorded and lost frames."""
    return {
        "is_recording": recorder.is_recording,
        "frames": recorder.frames,
        "bytes": recorder.bytes,
        "frames_lost": recorder.frames_lost,
        "failures": dict(recorder.failures),
    }


def policy_status(policy: Policy) -> dict[str, dict[str, dict[str, int]]]:
    """Refused frames by direction, message and reason."""
    status: dict[str, dict[str, dict[str, int]]] = {}
    for direction, gate in (("in", policy.incoming), ("out", policy.outgoing)):
        messages = status[direction] = {}
        for (msgid, refusal), count in gate.refused.items():
            name = "others" if msgid == ANY_OTHER else name_of(msgid)
            messages.setdefault(name, {})[refusal.value] = count
    return status


def commands_status(policy: Policy) -> dict[str, dict[str, dict[str, int]]]:
    """Refused COMMAND_LONG and COMMAND_INT by direction, command and reason."""
    status: dict[str, dict[str, dict[str, int]]] = {}
    for direction, gate in (("in", policy.incoming), ("out", policy.outgoing)):
        commands = status[direction] = {}
        for (_, command, refusal), count in gate.refused_commands.items():
            name = "others" if command == ANY_OTHER else command_name(command)
            counts = commands.setdefault(name, {})
            counts[refusal.value] = counts.get(refusal.value, 0) + count
    return status
