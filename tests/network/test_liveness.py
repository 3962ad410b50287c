"""From the moment one path is honest, no critical frame is lost or late; and histories find what breaks that."""

from __future__ import annotations

import os
from typing import Any

import pytest

from tests.network.liveness import Outcome, play
from uavlinkd.core import constants as c
from uavlinkd.core import freshness, receive, send
from uavlinkd.core.paths import PathSet
from uavlinkd.core.peer import Peer
from uavlinkd.core.session import Session
from uavlinkd.core.settings import Class
from uavlinkd.core.timers import Timer

HISTORIES = int(os.environ.get("UAVLINKD_LIVENESS_HISTORIES", "120"))


@pytest.mark.parametrize("batch", [range(20), pytest.param(range(1000, 1000 + HISTORIES), marks=pytest.mark.long)])
def test_one_honest_path_delivers_every_critical_frame_in_time(batch: range) -> None:
    """After any history, and whatever happens to the other paths."""
    total = Outcome()
    for seed in batch:
        outcome = play(seed)
        assert not outcome.violations, outcome.violations[0][1]
        total.add(outcome)
    assert total.judged > 20 * len(batch)


_set_routes, _ask_for_echo, _reply = PathSet._set_routes, send.ask_for_echo, receive._reply


def _only_paths_that_work(paths: PathSet, now: float) -> None:
    _set_routes(paths, now)
    critical = paths.routes[Class.CRITICAL]
    paths.routes[Class.CRITICAL] = tuple(state for state in critical if state is paths.best or state.works)


def _nothing(*_: Any) -> list[Any]:
    return []


def _asks_along_the_best(peer: Peer, session: Session, now: float, *_: Any) -> list[Any]:
    return _ask_for_echo(peer, session, now, peer.paths.echo_route)


def _answers_along_the_best(peer: Peer, session: Session, request: Any, _: Any, now: float) -> list[Any]:
    return _reply(peer, session, request, peer.paths.echo_route, now)


def _judges_paths_of_peers_that_are_up(peer: Peer) -> None:
    is_probed = peer.is_up and peer.sending_session() is not None
    peer.timers.set(Timer.PATHS, peer.paths.next_at if is_probed else c.NEVER)


PLANTS: dict[str, tuple[Any, str, Any]] = {
    "copies only along paths that work": (PathSet, "_set_routes", _only_paths_that_work),
    "questions along the best path": (freshness, "ask_for_echo", _asks_along_the_best),
    "answers along the best path": (receive, "_reply", _answers_along_the_best),
    "no answers to copies of requests": (receive, "_answer_copy", _nothing),
    "slots end when paths go down": (c, "FORMER_PATH_S", 0.0),
    "a network that appears waits for a session": (Peer, "set_paths_timer", _judges_paths_of_peers_that_are_up),
}


@pytest.mark.long
@pytest.mark.parametrize(("where", "name", "plant"), PLANTS.values(), ids=PLANTS)
def test_a_planted_fault_is_found(monkeypatch: pytest.MonkeyPatch, where: Any, name: str, plant: Any) -> None:
    """Within some hundred histories, the rarest one within some thousand."""
    monkeypatch.setattr(where, name, plant)
    assert any(play(seed).violations for seed in range(6000))
