"""Two paths in one session, one of which stalls: what failed before paths were specified."""

from __future__ import annotations

import pytest

from tests.network.attackers import Recorder
from tests.network.drone import Drone
from tests.network.network import Network
from tests.network.vehicle import hop, linked_vehicle
from uavlinkd.core import constants as c
from uavlinkd.core.drops import DropReason
from uavlinkd.core.settings import Class, Link, Timers
from uavlinkd.lab.mitm.radio import RadioSettings

OLDEST_S = c.LATE_AFTER_S + c.LATE_STEP_S + 0.5
"""The age of a delivered frame where two paths carry traffic: the longest gap between envelopes is 0.5 s."""
FAST, SLOW = RadioSettings(delay_s=0.02), RadioSettings(delay_s=0.1)


@pytest.mark.parametrize("stalled", [0, 1], ids=["best path", "other path"])
@pytest.mark.parametrize("rekey_after_s", [120.0, 2.0])
def test_path_that_stalls_for_ten_seconds_delivers_nothing_stale(stalled: int, rekey_after_s: float) -> None:
    """Everything on one path comes 10 s late: no frame is old or comes twice, no critical frame is lost."""
    with Network(f"stall {stalled} {rekey_after_s}") as network:
        link = Link(timers=Timers(rekey_after_s=rekey_after_s))
        vehicle, station = linked_vehicle(network, (FAST, SLOW), link)
        flows = network.talk(vehicle, station, 0.02)
        critical = network.talk(vehicle, station, 0.1, cls=Class.CRITICAL)
        recorder = Recorder(network)
        network.run(5)
        begin = network.now
        network.stall_path(hop(vehicle, station, stalled), 10)
        network.run(9.9)
        released = network.now
        before = {drone: drone.peer(other).traffic.drops.copy() for drone, other in _both(vehicle, station)}
        network.run(1.1)
        for drone, other in _both(vehicle, station):
            counted = drone.peer(other).traffic.drops - before[drone]
            assert set(counted) <= {"duplicate", "late_copy", "delayed", "unexpected_answer"}, counted
            ended = drone.drops["late"]  # of sessions that ended: they name no peer
            assert counted[DropReason.LATE_COPY] + ended > 20
            assert bool(ended) == (rekey_after_s < 10)
            assert counted[DropReason.DUPLICATE] > 5
        network.run(5)
        for flow in (*flows, *critical):
            assert flow.oldest_s < OLDEST_S
            flow.check_order()
        for flow in critical:
            assert not flow.lost(begin - 4, network.now - 1)
        for flow in flows:
            assert not flow.lost(released + 1, network.now - 1)
        # The same recording from an address that no path leads to is a replay.
        copies = [datagram for datagram, source, _ in recorder.recorded[-800:] if source in vehicle.addresses]
        refused = station.drops["replayed"]
        for datagram in copies:
            network.inject(datagram, ("198.51.100.9", 4000), station.addresses[0])
        network.run(1)
        assert station.drops["replayed"] > refused


def _both(vehicle: Drone, station: Drone) -> list[tuple[Drone, Drone]]:
    return [(vehicle, station), (station, vehicle)]
