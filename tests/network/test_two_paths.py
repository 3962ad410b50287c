"""Two paths in one session: what failed before paths were specified, one history each."""

from __future__ import annotations

import pytest

from tests.network.attackers import Recorder
from tests.network.drone import Drone
from tests.network.flow import Flow
from tests.network.network import Network
from tests.network.vehicle import hop, linked_vehicle
from uavlinkd.core import constants as c
from uavlinkd.core.drops import DropReason
from uavlinkd.core.settings import Class, Link, Redundancy, Timers
from uavlinkd.lab.mitm.radio import RadioSettings

OLDEST_S = c.LATE_AFTER_S + c.LATE_STEP_S + 0.5
"""The age of a delivered frame where two paths carry traffic: the longest gap between envelopes is 0.5 s."""
FAST, SLOW = RadioSettings(delay_s=0.02), RadioSettings(delay_s=0.1)


def newest_wins(flow: Flow) -> list[int]:
    """The frames of states that a shell passes on: those with a greater order than the last one, in that order."""
    passed: list[int] = []
    last = -1
    for number in flow.delivered:
        if flow.orders[number] > last:
            last = flow.orders[number]
            passed.append(number)
    return passed


def test_states_do_not_go_back() -> None:
    """Manual control at 25 Hz over a fast lossy path and a slow one: by the order, the shell drops what is older."""
    with Network("states", RadioSettings()) as network:
        radios = RadioSettings(delay_s=0.05, loss=0.3), RadioSettings(delay_s=0.4)
        station, vehicle = reversed(linked_vehicle(network, radios))
        flow = network.traffic(station, vehicle, 0.04, cls=Class.CRITICAL)
        begin = network.now + 1
        network.run(60)
        assert not flow.lost(begin, network.now - 1)
        assert flow.overtaken > 0.1 * len(flow.sent_at)
        flow.check_order()
        passed = newest_wins(flow)
        assert passed == sorted(passed)
        # Nothing else is dropped: a frame that is newer than all before it is passed on.
        arrived = list(flow.delivered)
        assert passed == [number for at, number in enumerate(arrived) if number == max(arrived[: at + 1])]


@pytest.mark.long
@pytest.mark.parametrize("redundancy", [Redundancy.CRITICAL, Redundancy.ALL])
def test_replay_window_holds_paths_that_differ_by_four_tenths_of_a_second(redundancy: Redundancy) -> None:
    """10,000 envelopes a second, and the fast path loses a third: the copies of the slow one fill every gap."""
    with Network(f"window {redundancy}") as network:
        radios = RadioSettings(delay_s=0.02), RadioSettings(delay_s=0.42)
        vehicle, station = linked_vehicle(network, radios, Link(redundancy=redundancy))
        network.checks_bounds = False  # for speed: nothing here grows
        cls = Class.CRITICAL if redundancy is Redundancy.CRITICAL else Class.STREAM
        network.traffic(vehicle, station, 0.0002, network.now + 3)
        flow = network.traffic(vehicle, station, 0.0002, network.now + 3, cls) if cls is Class.CRITICAL else None
        flow = flow or network.traffic(vehicle, station, 0.0002, network.now + 3)
        network.run(1)
        begin = network.now
        network.set_path(hop(vehicle, station, 0), RadioSettings(delay_s=0.02, loss=0.1))
        network.run(3)
        assert len(flow.sent_at) > 10_000
        assert not flow.lost(begin - 0.9, begin + 1.9)


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
