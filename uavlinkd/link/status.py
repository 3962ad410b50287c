"""What a daemon tells about itself: plain values, ready for JSON. No secret is among them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uavlinkd.system.addresses import Address
from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.config.keys import encode_key
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.policy.gate import ANY_OTHER
from uavlinkd.mavlink.policy.compilation import Policy

if TYPE_CHECKING:
    from uavlinkd.link.daemon import Daemon
    from uavlinkd.link.peer_link import PeerLink
    from uavlinkd.ops.recorder import Recorder


def daemon_status(daemon: Daemon, now: float) -> dict[str, object]:
    """The whole daemon. Times are seconds before now; rates are the reader's to make, from two of these."""
    node = daemon.node
    return {
        "name": daemon.config.name,
        "public_key": encode_key(node.public_key),
        "monotonic_s": now,
        "peers": {name: peer_status(link, now) for name, link in daemon.links.items()},
        "endpoints": {
            each.name: endpoint_status(each, daemon.endpoint_policies[each.name], now) for each in daemon.endpoints
        },
        "drops": {reason.value: amount for reason, amount in node.drops.items()},
        "stale": dict(daemon.stall.dropped),
        "unrouted": {reason.value: amount for reason, amount in daemon.switch.router.unrouted.items()},
        "send_failures": dict(daemon.peer_sockets.failures),
        "recording": None if daemon.recorder is None else recording_status(daemon.recorder),
    }


def peer_status(link: PeerLink, now: float) -> dict[str, object]:
    """One peer. ``state`` is ``up``, ``lost`` (was up) or ``waiting`` (never was)."""
    peer, figures = link.peer, link.figures
    session = peer.sessions.current
    traffic = peer.traffic
    expected_there, received_there = traffic.reported
    return {
        "state": "up" if peer.is_up else "lost" if peer.heard_at is not None else "waiting",
        "public_key": encode_key(peer.settings.public_key),
        "accepts_previous_key": link.accepts_previous_keys,
        "path": None if peer.path is None else str(Address(*peer.path[1:])),
        "heard_s": None if peer.heard_at is None else now - peer.heard_at,
        "handshake_s": None if peer.established_at is None else now - peer.established_at,
        "round_trip_s": peer.round_trip_s,
        "freshness_unverified_s": None if peer.unverified_since is None else now - peer.unverified_since,
        "loss_in": figures.loss_in,
        "loss_out": figures.loss_out,
        "bytes_in_s": link.bytes_s[0],
        "bytes_out_s": link.bytes_s[1],
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
        **link.disturbances(now),
        "frames_received": link.counters.frames,
        "frames_unknown": link.counters.unknown,
        "malformed": {fault.value: amount for fault, amount in link.counters.faults.items()},
        "refused": policy_status(link.policy),
        "waiting_dropped": {}
        if link.egress is None
        else {reason.value: amount for reason, amount in link.egress.totals.items()},
        "drops": {reason.value: amount for reason, amount in traffic.drops.items()},
    }


def endpoint_status(endpoint: Endpoint, policy: Policy, now: float) -> dict[str, object]:
    """One local endpoint, and who is there."""
    return {
        "programs": {
            port.name: {"heard_s": None if port.heard_at is None else now - port.heard_at} for port in endpoint.ports
        },
        "frames_received": endpoint.counters.frames,
        "frames_unknown": endpoint.counters.unknown,
        "frames_sent": endpoint.frames_sent,
        "bytes_received": endpoint.bytes_received,
        "bytes_sent": endpoint.bytes_sent,
        "garbage_bytes": endpoint.counters.garbage_bytes,
        "faults": {fault.value: amount for fault, amount in endpoint.counters.faults.items()},
        "failures": dict(endpoint.failures),
        "refused": policy_status(policy),
    }


def recording_status(recorder: Recorder) -> dict[str, object]:
    """What was recorded, and what was not."""
    return {
        "is_recording": recorder.is_recording,
        "frames": recorder.frames,
        "bytes": recorder.bytes,
        "frames_lost": recorder.frames_lost,
        "failures": dict(recorder.failures),
    }


def policy_status(policy: Policy) -> dict[str, dict[str, dict[str, int]]]:
    """What a policy refused: each way, by message, by reason."""
    told: dict[str, dict[str, dict[str, int]]] = {}
    for way, gate in (("in", policy.incoming), ("out", policy.outgoing)):
        messages = told[way] = {}
        for (msgid, refusal), amount in gate.refused.items():
            name = "others" if msgid == ANY_OTHER else name_of(msgid)
            messages.setdefault(name, {})[refusal.value] = amount
    return told
