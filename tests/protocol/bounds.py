"""Every table in a node that grows with the datagrams of others, with its limit in the specification."""

from __future__ import annotations

from collections import Counter

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.node import Node

Sizes = Counter[str]
"""The size of each table. For tables of a peer or session, the largest one."""

LIMITS: dict[str, int] = {
    "pending initiations of a peer": c.PENDING_PER_PEER,
    "unconfirmed sessions of a peer": 2 * c.UNCONFIRMED_PER_KIND,
    "confirmed sessions of a peer": c.USABLE_PER_PEER,
    "remembered initiations of a peer": c.REMEMBERED_MOST,
    "sources under load": c.SOURCES_TRACKED,
    "networks that get cookies": c.SOURCES_TRACKED,
    "sources of group work": c.SOURCES_TRACKED,
    "known addresses with shares": c.SOURCES_TRACKED,
    "echo requests that wait for an answer": 64,
    "refusals counted for a peer": c.REFUSALS_KEPT,
    "claims of a peer": c.REFUSALS_KEPT,
    "bytes held on a session": c.HELD_BYTES,
    "steps of the past of a session": int(c.LATE_AFTER_S / c.LATE_STEP_S) + 3,
    "indices in use or quarantine": 2**16 - 1,
    "configured paths of a peer": c.CONFIGURED_PATHS,
    "learned paths of a peer": c.LEARNED_PATHS,
    "questions that wait on a path": c.QUESTIONS_PER_PATH,
    "reports of a path": c.LOSS_POINTS,
    "paths that carried a response": c.COPIES_OF_A_RESPONSE,
    "cookies of a peer": c.COOKIES_PER_PEER,
    "addresses of proven paths of a peer": c.CONFIGURED_PATHS + c.LEARNED_PATHS,
    "keys that seem to be on two machines": 0,  # each is on one, and no attacker has it
}


def measure(node: Node) -> Sizes:
    """The size of every table."""
    peers = node._handshakes.peers.values()
    sessions = [session for peer in peers for session in peer.sessions.confirmed]
    histories = [part for session in sessions for part in (session._received_history, session._sent_history)]
    waiting = [waiting for peer in peers for waiting in peer.sessions.unconfirmed.values()]
    paths = [state for peer in peers for state in peer.paths.states]
    reports = [len(loss._points) for state in paths for loss in (state._loss_in, state._loss_out)]
    learned = [sum(not state.is_configured for state in peer.paths.states) for peer in peers]
    proven = [sum(state.is_known for state in peer.paths.states) for peer in peers]
    indices, admission = node._indices, node._handshakes.admission
    return Counter(
        {
            "pending initiations of a peer": max((len(peer.initiator.pending) for peer in peers), default=0),
            "unconfirmed sessions of a peer": max((len(peer.sessions.unconfirmed) for peer in peers), default=0),
            "confirmed sessions of a peer": max((len(peer.sessions.confirmed) for peer in peers), default=0),
            "remembered initiations of a peer": max((len(peer.remembered) for peer in peers), default=0),
            "sources under load": len(admission._sources._buckets),
            "networks that get cookies": len(admission._prefixes._buckets),
            "sources of group work": len(admission._group._sources._buckets),
            "known addresses with shares": max(
                len(shares._buckets)
                for shares in (admission._known, admission._known_read, admission._known_versions)
            ),
            "echo requests that wait for an answer": max((len(peer.echo_requests) for peer in peers), default=0),
            "refusals counted for a peer": max((len(peer.reports.refusals) for peer in peers), default=0),
            "claims of a peer": max((len(peer.claims.refusals()) for peer in peers), default=0),
            "bytes held on a session": max((session.held.size for session in sessions), default=0),
            "steps of the past of a session": max((len(part._steps) for part in histories), default=0),
            "indices in use or quarantine": len(indices.owners) + len(indices._quarantine),
            "configured paths of a peer": max((len(peer.paths.configured) for peer in peers), default=0),
            "learned paths of a peer": max(learned, default=0),
            "questions that wait on a path": max((len(state._waiting) for state in paths), default=0),
            "reports of a path": max(reports, default=0),
            "paths that carried a response": max((len(response.paths) for response in waiting), default=0),
            "cookies of a peer": max((len(peer.initiator._received_cookies) for peer in peers), default=0),
            "addresses of proven paths of a peer": max(proven, default=0),
            "keys that seem to be on two machines": sum(len(peer.sessions.twins) for peer in peers),
        }
    )


def check(node: Node) -> Sizes:
    """Every table is within its limit, the tables agree, and a removed peer is in none of them.

    Returns the sizes.
    """
    sizes = measure(node)
    for table, size in sizes.items():
        assert size <= LIMITS[table], f"{table}: {size} are more than {LIMITS[table]}"
    peers = node._handshakes.peers.values()
    owners = node._indices.owners
    held = sum(len(p.initiator.pending) + len(p.sessions.unconfirmed) + len(p.sessions.confirmed) for p in peers)
    assert len(owners) == held, f"{len(owners)} indices are owned, {held} by a peer"
    assert all(node.find(peer.settings.public_key) is peer for peer, _ in owners.values()), (
        "a removed peer owns an index"
    )
    assert not owners.keys() & node._indices._quarantine.keys(), "an index in quarantine is in use"
    assert len(node._handshakes.remembered) == sum(len(peer.remembered) for peer in peers)
    assert len(node._handshakes.peers) == len(node.peers) + len(node._provisional)
    assert all(node.peers.get(peer.name) is peer for peer in node._by_address.values())
    proven = [state.path.place for peer in peers for state in peer.paths.states if state.is_known]
    assert node._last_seen == Counter(proven), f"{node._last_seen} are known, {proven} are proven"
    assert len(node._by_address) <= sum(len(peer.paths.configured) for peer in peers)
    for peer in peers:
        numbers = [state.number for state in peer.paths.states]
        assert len(set(numbers)) == len(numbers), f"{peer.name}: two paths have one number: {numbers}"
        assert peer.paths.best is None or peer.paths.best in peer.paths.states, f"{peer.name}: the best path is gone"
    return sizes
