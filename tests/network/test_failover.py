"""What two paths gain and cost: one dies, recorded flights, a metered network."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.network.failover import RADIOS, Radios, fail_over
from tests.network.flights import fly, read_flight
from tests.network.metered import absent_peer_bytes, standby_bytes_a_day
from uavlinkd.core.settings import Redundancy

pytestmark = pytest.mark.long

TRIES = int(os.environ.get("UAVLINKD_FAILOVER_TRIES", "5"))
"""Failures with each pair of radios; each begins at a random moment."""
STREAM_GAP_S = 0.5
FLIGHTS = ("arducopter_sitl_flight.tlog", "ardusub_dive.tlog", "copter_flight_mavlink1.tlog")
FLIGHT_S = float(os.environ.get("UAVLINKD_FLIGHT_SECONDS", "180"))


@pytest.mark.parametrize("radios", RADIOS, ids=lambda radios: radios.name)
def test_no_critical_frame_is_lost_when_one_of_two_paths_dies(radios: Radios) -> None:
    """The gap of critical frames is that of the surviving path alone, within the jitter. The stream stops shortly."""
    for seed in range(TRIES):
        result, alone = fail_over(radios, seed), fail_over(radios, seed, survivor_alone=True)
        assert result.critical_lost == 0
        assert result.critical_sent > 100
        assert result.critical_gap_s <= alone.critical_gap_s + radios.jitter_s
        assert result.stream_gap_s <= STREAM_GAP_S
        assert result.stream_lost > 0  # the failure was real
        assert result.return_gap_s <= 0.1


@pytest.mark.parametrize("flight", FLIGHTS)
def test_redundancy_costs_at_most_a_quarter_by_default(shared_data: Path, flight: str) -> None:
    """Copies and probes in both directions, manual control apart. Copies of everything cost as much again."""
    batches = read_flight(shared_data / flight, FLIGHT_S)
    alone = fly(batches, 1, Redundancy.CRITICAL)
    both = fly(batches, 2, Redundancy.CRITICAL)
    everything = fly(batches, 2, Redundancy.ALL)
    frames = sum(len(batch.frames) for batch in batches)
    assert alone.delivered_frames == both.delivered_frames == everything.delivered_frames == frames
    assert both.with_headers <= 1.25 * alone.with_headers
    assert 1.9 * alone.with_headers <= everything.with_headers <= 2.3 * alone.with_headers


def test_metered_path_that_stands_by_carries_little() -> None:
    """Only heartbeats and a question now and then: a tenth of what the same path carries if it is not metered."""
    assert standby_bytes_a_day(heartbeats=False) < 10e6
    assert standby_bytes_a_day(heartbeats=False) < standby_bytes_a_day(heartbeats=True)


def test_peer_that_is_off_costs_a_metered_path_little() -> None:
    """One initiation a minute, whatever the number of paths."""
    hour = absent_peer_bytes(3600.0)
    assert 0 < hour < 1.5 * (3600 / 60 + 540 / 15 + 60 / 0.25) * 200
    assert absent_peer_bytes(3600.0, addresses=4) < 4 * hour
