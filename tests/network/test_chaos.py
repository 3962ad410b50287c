"""Random faults together: losses, cuts, restarts, moves, floods, removals. Then the network works again.

A few of the histories that ``python -m tests.network`` plays by the thousand, and that it finds what is broken.
"""

from __future__ import annotations

import os
from typing import Any

import pytest

from tests.network.histories import Played, play
from tests.network.plans import BUSY, HOURS, LARGE, LINES, MANY_PATHS, PATHS, Plan
from uavlinkd.core import constants as c
from uavlinkd.core import establish
from uavlinkd.core.counters import ReplayWindow
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.initiator import Initiator
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output
from uavlinkd.core.path import Path, SocketFacts
from uavlinkd.core.paths import PathSet
from uavlinkd.core.peer import Peer
from uavlinkd.core.session import Session
from uavlinkd.core.settings import Class

pytestmark = pytest.mark.long

SEEDS = int(os.environ.get("UAVLINKD_CHAOS_SEEDS", "8"))
"""Number of random histories: most of them small and busy."""


@pytest.mark.parametrize("batch", range(8))
def test_links_are_back_soon_after_any_history(batch: int) -> None:
    """Random faults; three seconds after the last, every pair is up, and no property was violated."""
    for seed in range(batch, SEEDS, 8):
        _assert_sound(play(seed, BUSY))


@pytest.mark.parametrize(("plan", "seed"), [(LARGE, 4), (HOURS, 4)], ids=["large", "hours"])
def test_a_large_fleet_and_a_long_flight(plan: Plan, seed: int) -> None:
    """One history of a dozen drones or more, and one of hours with its changes of keys."""
    _assert_sound(play(seed, plan))


@pytest.mark.parametrize("batch", range(4))
def test_one_usable_path_is_enough_after_any_history(batch: int) -> None:
    """Paths fail one by one, in any way: peers with one usable path are up, and no critical frame is lost."""
    for seed in range(batch, SEEDS // 2, 4):
        played = play(seed, PATHS)
        _assert_sound(played)
        assert played.critical_judged


def test_a_large_fleet_with_many_paths() -> None:
    """A dozen drones or more, each with up to four networks."""
    played = play(4, MANY_PATHS)
    _assert_sound(played)
    assert played.critical_judged


def test_a_serial_line_beside_another_path() -> None:
    """Modems that lose, alter and are pulled: the line alone is enough, and damaged bytes are not delivered."""
    total = Played()
    for seed in range(SEEDS // 2):
        played = play(seed, LINES)
        _assert_sound(played)
        total.add(played)
    assert total.critical_on_lines > 100
    assert total.damaged > 20


def _assert_sound(played: Played) -> None:
    assert not played.violations, played.violations[0][1]
    assert played.judged
    assert played.delivered


def _nothing(*_: Any, **__: Any) -> None:
    """Planted instead of a check."""


def _keeps_a_removed_peer(node: Node, peer: Peer, now: float) -> list[Output]:
    node._handshakes.peers = {keys: known for keys, known in node._handshakes.peers.items() if known is not peer}
    del node.peers[peer.name]
    return []


def _initiates_once(initiator: Initiator, now: float, *, is_metered: bool = False, slow_at: float = 0.0) -> None:
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


def _tries_one_path(paths: PathSet, *, is_answering: bool = True) -> tuple[list[Path], list[Path]]:
    return [state.path for state in paths.states[:1]], []


def _counts_arrivals(session: Session, counter: int) -> int:
    return session.order_base + session.received


def _raises(peer: Peer, *_: Any) -> None:
    raise KeyError(peer.name)


PLANTS: dict[str, tuple[Any, str, Any, str, Plan]] = {
    "no replay window": (ReplayWindow, "is_used", _nothing, "delivered twice", BUSY),
    "a removed peer keeps its keys": (Node, "remove_peer", _keeps_a_removed_peer, "owned, 0 by a peer", BUSY),
    "indices leak": (Initiator, "_forget", _keeps_the_index, "indices are owned", BUSY),
    "one initiation is all": (Initiator, "begin_try", _initiates_once, "not within", BUSY),
    "an exception": (establish, "receive_hint", _raises, "KeyError", BUSY),
    "no copies": (PathSet, "_set_routes", _copies_nothing, "was lost although paths", PATHS),
    "handshakes along one path": (PathSet, "handshake_paths", _tries_one_path, "not within", PATHS),
    "no order": (Session, "order_of", _returns_zero, "the order is unknown", PATHS),
    "order by arrival": (Session, "order_of", _counts_arrivals, "is before", PATHS),
    "lines lead nowhere": (SocketFacts, "check_network", _leads_nowhere, "was lost although paths", LINES),
    "slots without end": (c, "LEARNED_PATHS", 99, "learned paths of a peer", PATHS),
}


@pytest.mark.parametrize(("where", "name", "plant", "message", "plan"), PLANTS.values(), ids=PLANTS)
def test_a_planted_bug_is_found(
    monkeypatch: pytest.MonkeyPatch, where: Any, name: str, plant: Any, message: str, plan: Plan
) -> None:
    """A history finds each broken property soon."""
    monkeypatch.setattr(where, name, plant)
    violations: list[str] = []
    for seed in (2, 7, 1, 3, 0):  # the short ones first
        violations += [what for _, what in play(seed, plan).violations]
        if any(message in what for what in violations):
            return
    pytest.fail(f"not found, but {violations}")


def test_the_same_seed_plays_the_same_history() -> None:
    """The seed alone reproduces a history."""
    first, again = play(10, BUSY), play(10, BUSY)
    first.cpu_s = again.cpu_s = 0.0
    assert first == again
