"""Everything at once, drawn by lot: losses, cuts, restarts, moves, floods, removals. Then the network behaves.

A few of the histories that ``python -m tests.network`` plays by the thousand, and that it finds what is broken.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import pytest

from tests.network.command import main
from tests.network.histories import BUSY, HOURS, LARGE, Plan, Played, play
from uavlinkd.core.initiator import Caller
from uavlinkd.core.indices import Indices
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output
from uavlinkd.core.peer import Peer
from uavlinkd.core.replay import ReplayWindow

SEEDS = int(os.environ.get("UAVLINKD_CHAOS_SEEDS", "8"))
"""How many drawn histories are played: most of them small and busy."""


@pytest.mark.parametrize("batch", range(8))
def test_links_are_back_soon_after_any_history(batch: int) -> None:
    """Misfortunes drawn by lot; three seconds after the last, every pair is up, and nothing was as it must not be."""
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
    """What is planted in the place of a check."""


def _keeps_a_removed_peer(node: Node, name: str, now: float) -> list[Output]:
    node._by_keys = {keys: each for keys, each in node._by_keys.items() if each.name != name}
    del node.peers[name]
    return []


def _calls_once(caller: Caller, candidates: int, now: float) -> None:
    caller.retry_at = now + 100.0


def _raises(peer: Peer, *_: Any) -> None:
    raise KeyError(peer.name)


PLANTS: dict[str, tuple[type, str, Callable[..., Any], str]] = {
    "no replay window": (ReplayWindow, "check", _nothing, "delivered twice"),
    "a removed peer keeps its keys": (Node, "remove_peer", _keeps_a_removed_peer, "d1 has removed d0"),
    "indices leak": (Indices, "forget", _nothing, "indices are owned"),
    "one call is all": (Caller, "_schedule", _calls_once, "not within"),
    "an exception": (Peer, "hint", _raises, "KeyError"),
}


@pytest.mark.parametrize(("where", "name", "plant", "told"), PLANTS.values(), ids=PLANTS)
def test_a_planted_bug_is_found(
    monkeypatch: pytest.MonkeyPatch, where: type, name: str, plant: Callable[..., Any], told: str
) -> None:
    """Each thing that must hold fails a history once it is broken, soon."""
    monkeypatch.setattr(where, name, plant)
    found: list[str] = []
    for seed in (2, 1, 3, 0):  # the short ones first
        found += [what for _, what in play(seed, BUSY).violations]
        if any(told in what for what in found):
            return
    pytest.fail(f"not found, but {found}")


def test_the_same_seed_plays_the_same_history() -> None:
    """A seed is all that is needed to see it again."""
    first, again = play(10, BUSY), play(10, BUSY)
    first.cpu_s = again.cpu_s = 0.0
    assert first == again


def test_the_command_tells_what_was_played(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Sound histories give 0 and a table; one that is not gives 1 and the seed to see it again."""
    assert main(["--minutes", "0.1", "--first-seed", "18", "--handshakes", "20"]) == 0
    told = capsys.readouterr().out
    assert "virtual minutes" in told
    assert "30 % loss each way, one knows: 20 handshakes" in told
    monkeypatch.setattr(Indices, "forget", _nothing)
    assert main(["--seed", "10"]) == 1
    assert "indices are owned" in capsys.readouterr().out
