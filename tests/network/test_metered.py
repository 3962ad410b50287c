"""Paths that are paid by the byte: they carry little, and are used when they are needed, and at once then."""

from __future__ import annotations

from functools import partial

import pytest

from tests.network.drone import Drone, share_a_session
from tests.network.network import Network
from tests.network.vehicle import hop, linked_vehicle
from uavlinkd.core.settings import Class
from uavlinkd.lab.mitm.radio import RadioSettings

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
