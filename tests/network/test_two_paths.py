"""Two paths in one session, one of which stalls, or is paid by the byte: it carries little and is ready at once."""

from __future__ import annotations

import os
from functools import partial
from random import Random

import pytest

from tests.network.drone import Drone, share_a_session
from tests.network.network import Network
from tests.network.vehicle import hop, linked_vehicle
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.settings import Class, Link

DEATHS = int(os.environ.get("UAVLINKD_DEATHS", "20"))
SEEN_AFTER_S = 0.5
"""So long after its return, the other path has answered, and may not have proved itself yet."""


def _death(seed: int) -> tuple[float, float]:
    """The best path dies while the other one returns: how long ago it did, and the longest gap of the stream."""
    rng = Random(f"death {seed}")
    radios = [RadioSettings(delay_s=rng.uniform(0.0025, 0.05)) for _ in range(2)]
    with Network(f"death {seed}") as network:
        vehicle, station = linked_vehicle(network, radios, Link())
        flow = network.traffic(vehicle, station, 0.02)
        network.run(4 + network.rng.random())
        best = vehicle.peer(station).path
        assert best is not None
        away_s, since_s = rng.uniform(0.2, 6), rng.uniform(0, 6)
        network.cut_path(hop(vehicle, station, 1 - best.socket))
        network.run(away_s)
        network.heal_path(hop(vehicle, station, 1 - best.socket))
        network.run(since_s)
        best, died = vehicle.peer(station).path, network.now
        assert best is not None
        network.cut_path(hop(vehicle, station, best.socket))
        network.run(5)
        return since_s, flow.longest_gap(died - 1, network.now)


@pytest.mark.long
def test_deaths_of_a_path_while_the_other_one_returns_leave_short_gaps() -> None:
    """The best one is asked as often as beside a usable one, so its death is seen soon."""
    deaths = [_death(seed) for seed in range(DEATHS)]
    gaps = sorted(gap for _, gap in deaths)
    seen = sorted(gap for since_s, gap in deaths if since_s >= SEEN_AFTER_S)
    for name, those in (("all", gaps), (f"returned {SEEN_AFTER_S} s ago", seen)):
        print(f"{name}: {len(those)}, median {those[len(those) // 2]:.3f} s,", end=" ")
        print(f"99 % {those[99 * len(those) // 100]:.3f} s, longest {those[-1]:.3f} s")
    assert gaps[-1] < 1.0
    assert seen[-1] < 0.5


MESH, LTE = 0, 1
RADIOS = RadioSettings(delay_s=0.02), RadioSettings(delay_s=0.05)
UP_WITHIN_S = 3.0


def _linked(network: Network) -> tuple[Drone, Drone]:
    vehicle, station = linked_vehicle(network, RADIOS)
    vehicle.set_metered([LTE])
    network.talk(vehicle, station)
    network.talk(vehicle, station, 0.5, cls=Class.CRITICAL)
    network.run(20)
    return vehicle, station


@pytest.mark.long
def test_peer_that_closed_is_found_along_the_metered_path_alone() -> None:
    """The mesh worked until the station closed its sessions, and is gone when it is back: LTE connects them."""
    for seed in range(5):
        with Network(f"only metered {seed}") as network:
            vehicle, station = _linked(network)
            station.knows(vehicle)  # it has to be found
            assert station.node is not None
            network.perform(station, station.node.close(station.local_now))
            station.stop()
            network.run(20 + network.rng.random())
            network.cut_path(hop(vehicle, station, MESH))
            station.start()
            network.run_until(partial(share_a_session, vehicle, station), UP_WITHIN_S)


@pytest.mark.long
def test_critical_frames_cross_where_a_metered_path_returns_as_the_other_one_dies() -> None:
    """The vehicle asks along LTE every 15 s only. It learns that LTE is back from the station's questions."""
    for seed in range(5):
        with Network(f"metered returns {seed}") as network:
            vehicle, station = _linked(network)
            network.cut_path(hop(vehicle, station, LTE))
            network.run(40 + 15 * network.rng.random())
            network.heal_path(hop(vehicle, station, LTE))
            network.cut_path(hop(vehicle, station, MESH))
            begin = network.now
            network.run(10)
            for sender, receiver in ((vehicle, station), (station, vehicle)):
                flow = network.flow(sender, receiver, Class.CRITICAL)
                assert flow.first_delivery(begin) < begin + UP_WITHIN_S
                assert not flow.lost(begin + UP_WITHIN_S, network.now - 1)
