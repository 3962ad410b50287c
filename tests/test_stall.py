"""A pause of the whole process is noticed at its first turn, and lasts as long as what it left to read."""

from __future__ import annotations

from uavlinkd.stall import FLUSH_AT_MOST_S, FLUSH_S, STALL_S, TURN_S, StallWatch


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
    for number in range(1, 5):
        assert watch.turn(end + number * TURN_S)
    assert watch.turn(end + FLUSH_S - 0.001)
    assert not watch.turn(end + FLUSH_S)
    assert pauses == [end - 10.0]


def test_waits_for_the_processor_after_a_pause_do_not_empty_the_sockets() -> None:
    """On a busy machine the first work after a pause comes in pieces; what is read between them had waited too."""
    watch = StallWatch(0.0, lambda pause_s: None)
    assert watch.turn(10.0)
    assert watch.turn(10.2)
    assert watch.turn(10.4), "a quarter of a second has passed, most of it without work"
    assert watch.turn(10.6)
    assert watch.turn(10.64)
    assert watch.turn(10.68)
    assert not watch.turn(10.72), "three waits of 0.2 s count as 0.05 s each"


def test_flush_ends_in_time_where_turns_are_rare() -> None:
    """A heartbeat a second: one is dropped at most."""
    watch = StallWatch(0.0, lambda pause_s: None)
    assert watch.turn(10.0)
    assert watch.turn(10.0 + FLUSH_AT_MOST_S - 0.001)
    assert not watch.turn(10.0 + FLUSH_AT_MOST_S)
