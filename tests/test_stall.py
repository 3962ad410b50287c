"""A pause of the whole process is noticed at its first turn, and lasts as long as what it left to read."""

from __future__ import annotations

from uavlinkd.stall import FLUSH_S, STALL_S, StallWatch


def test_an_ordinary_turn_is_none() -> None:
    """Up to the bound nothing is stale, and each turn begins the count again."""
    pauses: list[float] = []
    watch = StallWatch(0.0, pauses.append)
    assert not watch.turn(STALL_S)
    assert not watch.turn(2 * STALL_S)
    assert pauses == []


def test_a_pause_makes_what_is_read_after_it_stale_for_a_moment() -> None:
    """Just beyond the bound it is told once, and frames are stale until the backlog is read."""
    pauses: list[float] = []
    watch = StallWatch(10.0, pauses.append)
    end = 10.0 + STALL_S + 0.001
    assert watch.turn(end)
    assert watch.turn(end)
    assert watch.turn(end + FLUSH_S - 0.001)
    assert not watch.turn(end + FLUSH_S)
    assert pauses == [end - 10.0]
