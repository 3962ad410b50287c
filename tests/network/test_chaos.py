"""Random faults together: losses, cuts, restarts, moves, floods, removals. Then the network works again.

A few of the histories that ``python -m tests.network`` plays by the thousand, and that it finds what is broken.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import pytest

from tests.network.command import main
from tests.network.histories import BUSY, HOURS, LARGE, Plan, Played, play
from uavlinkd.core import establish
from uavlinkd.core.indices import Indices
from uavlinkd.core.initiator import Initiator
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output
from uavlinkd.core.path import Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.replay import ReplayWindow

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


def _assert_sound(played: Played) -> None:
    assert not played.violations, played.violations[0][1]
    assert played.judged
    assert played.delivered


def _nothing(*_: Any, **__: Any) -> None:
    """Planted instead of a check."""


def _keeps_a_removed_peer(node: Node, peer: Peer, now: float) -> list[Output]:
    node._by_keys = {keys: known for keys, known in node._by_keys.items() if known is not peer}
    del node.peers[peer.name]
    return []


def _initiates_once(initiator: Initiator, candidates: list[Path], now: float) -> Path:
    initiator.retry_at = now + 100.0
    return candidates[0]


def _raises(peer: Peer, *_: Any) -> None:
    raise KeyError(peer.name)


PLANTS: dict[str, tuple[Any, str, Callable[..., Any], str]] = {
    "no replay window": (ReplayWindow, "check", _nothing, "delivered twice"),
    "a removed peer keeps its keys": (Node, "remove_peer", _keeps_a_removed_peer, "d1 has removed d0"),
    "indices leak": (Indices, "forget", _nothing, "indices are owned"),
    "one initiation is all": (Initiator, "next_path", _initiates_once, "not within"),
    "an exception": (establish, "receive_hint", _raises, "KeyError"),
}


@pytest.mark.parametrize(("where", "name", "plant", "message"), PLANTS.values(), ids=PLANTS)
def test_a_planted_bug_is_found(
    monkeypatch: pytest.MonkeyPatch, where: Any, name: str, plant: Callable[..., Any], message: str
) -> None:
    """A history finds each broken property soon."""
    monkeypatch.setattr(where, name, plant)
    violations: list[str] = []
    for seed in (2, 1, 3, 0):  # the short ones first
        violations += [what for _, what in play(seed, BUSY).violations]
        if any(message in what for what in violations):
            return
    pytest.fail(f"not found, but {violations}")


def test_the_same_seed_plays_the_same_history() -> None:
    """The seed alone reproduces a history."""
    first, again = play(10, BUSY), play(10, BUSY)
    first.cpu_s = again.cpu_s = 0.0
    assert first == again


def test_the_command_reports_the_result(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Histories without violations return 0 and a table; a violation returns 1 and its seed."""
    assert main(["--minutes", "0.1", "--first-seed", "18", "--handshakes", "20"]) == 0
    output = capsys.readouterr().out
    assert "virtual minutes" in output
    assert "30 % loss in each direction, one knows: 20 handshakes" in output
    monkeypatch.setattr(Indices, "forget", _nothing)
    assert main(["--seed", "10"]) == 1
    assert "indices are owned" in capsys.readouterr().out
