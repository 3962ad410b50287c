"""Faults planted in the core: each is an attribute, and what replaces it. Random histories must find every one."""

from __future__ import annotations

from typing import Any

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import freshness, receive, send
from uavlinkd.protocol.counters import ReplayWindow
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.initiator import Initiator
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output
from uavlinkd.protocol.path import Path, SocketFacts
from uavlinkd.protocol.paths import PathSet
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.settings import Class
from uavlinkd.protocol.timers import Timer

Fault = tuple[Any, str, Any]
"""The owner of an attribute, its name, and what replaces it."""


def _nothing(*_: Any, **__: Any) -> None:
    """Planted instead of a check."""


def _keeps_a_removed_peer(node: Node, peer: Peer, now: float) -> list[Output]:
    node._handshakes.peers = {keys: known for keys, known in node._handshakes.peers.items() if known is not peer}
    del node.peers[peer.name]
    return []


def _initiates_once(initiator: Initiator, now: float, due_at: float = 0.0) -> None:
    initiator.retry_at = now + 100.0


def _returns_zero(*_: Any) -> int:
    return 0


def _leads_nowhere(facts: SocketFacts, _peer: Any, path: Path) -> None:
    if path.socket in facts.peer_at:
        raise Drop(DropReason.WRONG_NETWORK)


_set_routes = PathSet._set_routes


def _keeps_the_index(initiator: Initiator, index: int) -> None:
    del initiator.pending[index]


def _copies_nothing(paths: PathSet, now: float) -> None:
    _set_routes(paths, now)
    paths.routes = dict.fromkeys(Class, paths.routes[Class.BULK])


def _tries_one_path(paths: PathSet, *, is_answering: bool = True) -> list[Path]:
    return [state.path for state in paths.states[:1]]


def _counts_arrivals(session: Session, counter: int) -> int:
    return session.order_base + session.received


def _raises(peer: Peer, *_: Any) -> None:
    raise KeyError(peer.name)


_ask_for_echo, _reply = send.ask_for_echo, receive._reply


def _only_paths_that_work(paths: PathSet, now: float) -> None:
    _set_routes(paths, now)
    critical = paths.routes[Class.CRITICAL]
    working = tuple(state for state in critical if state is paths.best or state.works)
    paths.routes = {**paths.routes, Class.CRITICAL: working}


def _no_outputs(*_: Any) -> list[Any]:
    return []


def _asks_along_the_best(peer: Peer, session: Session, now: float, *_: Any) -> list[Any]:
    return _ask_for_echo(peer, session, now, peer.paths.echo_route)


def _answers_along_the_best(peer: Peer, session: Session, request: Any, _: Any, now: float) -> list[Any]:
    return _reply(peer, session, request, peer.paths.echo_route, now)


def _judges_paths_of_peers_that_are_up(peer: Peer) -> None:
    is_probed = peer.is_up and peer.sending_session() is not None
    peer.timers.set(Timer.PATHS, peer.paths.due_at if is_probed else c.NEVER)


FAULTS: dict[str, Fault] = {
    "no replay window": (ReplayWindow, "is_used", _nothing),
    "a removed peer keeps its keys": (Node, "remove_peer", _keeps_a_removed_peer),
    "indices leak": (Initiator, "_forget", _keeps_the_index),
    "one initiation is all": (Initiator, "begin_try", _initiates_once),
    "an exception": (receive, "receive_hint", _raises),
    "no copies": (PathSet, "_set_routes", _copies_nothing),
    "handshakes along one path": (PathSet, "handshake_paths", _tries_one_path),
    "no order": (Session, "order_of", _returns_zero),
    "order by arrival": (Session, "order_of", _counts_arrivals),
    "lines lead nowhere": (SocketFacts, "check_network", _leads_nowhere),
    "slots without end": (c, "LEARNED_PATHS", 99),
}

LIVENESS_FAULTS: dict[str, Fault] = {
    "copies only along paths that work": (PathSet, "_set_routes", _only_paths_that_work),
    "questions along the best path": (freshness, "ask_for_echo", _asks_along_the_best),
    "answers along the best path": (receive, "_reply", _answers_along_the_best),
    "no answers to copies of requests": (receive, "_answer_copy", _no_outputs),
    "slots end when paths go down": (c, "FORMER_PATH_S", 0.0),
    "a network that appears waits for a session": (Peer, "set_paths_timer", _judges_paths_of_peers_that_are_up),
}
