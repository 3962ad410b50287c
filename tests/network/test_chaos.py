"""Random faults together: losses, cuts, restarts, moves, floods, removals. Then the network works again.

A few of the histories that ``python -m tests.network`` plays by the thousand, and that it finds what is broken.
"""

from __future__ import annotations

import os

import pytest

from tests.network.histories import Played, play
from tests.network.plans import BUSY, HOURS, LARGE, LINES, MANY_PATHS, PATHS, Plan
from tests.protocol.plants import FAULTS

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


FOUND: dict[str, tuple[str, Plan]] = {
    "no replay window": ("delivered twice", BUSY),
    "a removed peer keeps its keys": ("owned, 0 by a peer", BUSY),
    "indices leak": ("indices are owned", BUSY),
    "one initiation is all": ("not within", BUSY),
    "an exception": ("KeyError", BUSY),
    "no copies": ("was lost although paths", PATHS),
    "handshakes along one path": ("not within", PATHS),
    "no order": ("the order is unknown", PATHS),
    "order by arrival": ("is before", PATHS),
    "lines lead nowhere": ("was lost although paths", LINES),
    "slots without end": ("learned paths of a peer", PATHS),
}
"""What a history with a planted fault violates, and which histories find it."""


@pytest.mark.parametrize("fault", FOUND)
def test_a_planted_bug_is_found(monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    """A history finds each broken property soon."""
    monkeypatch.setattr(*FAULTS[fault])
    message, plan = FOUND[fault]
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
