"""The rate of a serial network: halved when a modem queues, and growing again."""

from __future__ import annotations

import pytest

from uavlinkd.link.serial_networks import (
    LATER_S,
    LEAST_SHARE,
    SHORTEST_OF_S,
    LineRate,
)

FULL = 9_600.0
ENVELOPE = 300
WAIT_S = 2 * 8 * ENVELOPE / FULL
"""Two envelopes ahead."""


def test_rate_stays_while_round_trips_vary_a_little() -> None:
    """By what the envelopes of both ends take, and half a second."""
    rate = LineRate(FULL, ENVELOPE, 0.0)
    assert not rate.add_round_trip(0.2, 0.0)
    assert not rate.add_round_trip(0.2 + WAIT_S + LATER_S, 1.0)
    assert rate.bits_s(1.0) == FULL


def test_one_queue_halves_the_rate_once() -> None:
    """Answers to questions from before the halving do not count; later ones do."""
    rate = LineRate(FULL, ENVELOPE, 0.0)
    rate.add_round_trip(0.2, 0.0)
    assert rate.add_round_trip(3.0, 10.0)
    assert not rate.add_round_trip(3.0, 12.0)
    assert rate.add_round_trip(3.0, 13.1)


def test_rate_has_a_least_value() -> None:
    """However late the answers are, while the shortest one is remembered."""
    rate = LineRate(FULL, 1, 0.0)
    rate.add_round_trip(0.1, 0.0)
    for at in range(1, 30):
        rate.add_round_trip(1.5, at * 1.6)
    assert rate.bits_s(0.0) == pytest.approx(FULL * LEAST_SHARE)


def test_shortest_round_trip_is_that_of_the_last_minute() -> None:
    """A radio that became slower is compared with what it does now."""
    rate = LineRate(FULL, ENVELOPE, 0.0)
    rate.add_round_trip(0.1, 0.0)
    rate.add_round_trip(0.9, 30.0)
    assert not rate.add_round_trip(1.5, SHORTEST_OF_S + 1)
    assert rate.add_round_trip(0.95 + WAIT_S + LATER_S, SHORTEST_OF_S + 2)


def test_a_day_without_a_look_grows_to_the_full_rate() -> None:
    """As after a suspend: the power of so many seconds would overflow."""
    rate = LineRate(FULL, ENVELOPE, 0.0)
    rate.add_round_trip(0.2, 0.0)
    assert rate.add_round_trip(5.0, 5.0)
    assert rate.bits_s(86_400.0) == FULL
