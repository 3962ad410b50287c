"""Two paths in one session: what failed before paths were specified, one history each."""

from __future__ import annotations

from functools import partial

import pytest

from tests.network.attackers import Recorder
from tests.network.drone import Drone, share_a_session
from tests.network.flow import Flow
from tests.network.network import Network
from tests.network.vehicle import add_vehicle, at_station, at_vehicle, hop, linked_vehicle
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.path_state import PathCondition
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


def test_order_is_known_when_a_second_path_appears() -> None:
    """A path is configured during a session: from then on each frame has an order, on older sessions too."""
    with Network("second path", FAST) as network:
        vehicle, station = add_vehicle(network, (FAST, SLOW))
        settings, paths = vehicle.acquaintances[station.name]
        vehicle.acquaintances[station.name] = settings, paths[:1]
        vehicle.start()
        station.start()
        flows = network.talk(vehicle, station, 0.02)
        network.run(5)
        assert vehicle.node is not None
        vehicle.node.set_paths(vehicle.peer(station), paths, vehicle.local_now)
        network.run(1)
        assert vehicle.peer(station).paths.is_multiple
        begin = network.now
        network.run(1)
        for flow in flows:
            recent = [number for number, at in flow.delivered.items() if at > begin]
            assert recent
            assert all(flow.orders[number] > 0 for number in recent)
            flow.check_order()


@pytest.mark.parametrize("way", ["responses", "initiations"])
def test_fastest_path_may_lose_all_responses(way: str) -> None:
    """A path loses everything in one direction from the start: the other one makes a session within two tries."""
    for seed in range(5):
        with Network(f"lost responses {way} {seed}") as network:
            vehicle, station = add_vehicle(network, (FAST, SLOW), is_known=False)
            lossy = hop(vehicle, station, 0)
            network.air.cut(lossy.back if way == "responses" else lossy, network.now)
            recorder = Recorder(network)
            network.talk(vehicle, station)
            vehicle.start()
            station.start()
            network.run_until(partial(share_a_session, vehicle, station), within_s=1)
            ephemerals = {
                wire.parse_initiation(datagram).ephemeral
                for datagram, source, _ in recorder.recorded
                if datagram[0] == wire.INITIATION and source in vehicle.addresses
            }
            assert len(ephemerals) <= 2
            begin = network.now + 1
            network.run(5)
            for flow in network.flows.values():
                assert not flow.lost(begin, network.now - 0.5)


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


def test_loss_of_a_path_is_its_own() -> None:
    """Every frame arrives along one path; probes on a dead one are not lost frames. A lossy path shows its loss."""
    with Network("loss of a path") as network:
        vehicle, station = linked_vehicle(network, (FAST, SLOW))
        network.talk(vehicle, station)
        network.cut_path(hop(vehicle, station, 1))
        network.run(20)
        for state, dead in (
            (at_vehicle(vehicle, station, 0), at_vehicle(vehicle, station, 1)),
            (at_station(vehicle, station, 0), None),  # it gave up the other one, or knows it by configuration
        ):
            assert state.condition is PathCondition.USABLE
            assert state.loss_in == state.loss_out == 0.0
            assert dead is None or dead.condition is PathCondition.DOWN
        network.air.set_hop(hop(vehicle, station, 0), RadioSettings(delay_s=0.02, loss=0.15), network.now)
        network.run(20)
        sent, received = at_vehicle(vehicle, station, 0), at_station(vehicle, station, 0)
        assert sent.loss_out == pytest.approx(0.15, abs=0.1)
        assert received.loss_in == pytest.approx(0.15, abs=0.1)
        assert sent.loss_in == received.loss_out == 0.0


def test_slower_path_is_validated_although_it_only_carries_copies() -> None:
    """200 copies come later than along the first path: the far side validates the second one nevertheless."""
    for seed in range(5):
        with Network(f"copies {seed}", RadioSettings()) as network:
            vehicle, station = add_vehicle(network, (FAST, RadioSettings(delay_s=0.2)), is_known=False)
            vehicle.start()
            station.start()
            network.traffic(vehicle, station, 0.02, cls=Class.CRITICAL)
            network.run(4.5)
            assert at_vehicle(vehicle, station, 1).condition is PathCondition.USABLE
            assert at_station(vehicle, station, 1).condition is PathCondition.USABLE
            assert at_station(vehicle, station, 1).duplicates > 100


@pytest.mark.parametrize("stalled", [0, 1], ids=["best path", "other path"])
@pytest.mark.parametrize("rekey_after_s", [120.0, 2.0])
def test_path_that_stalls_for_ten_seconds_delivers_nothing_stale(stalled: int, rekey_after_s: float) -> None:
    """Everything on one path comes 10 s late: no frame is old or comes twice, no critical frame is lost."""
    with Network(f"stall {stalled} {rekey_after_s}") as network:
        link = Link(timers=Timers(rekey_after_s=rekey_after_s))
        vehicle, station = linked_vehicle(network, (FAST, SLOW), link)
        flows = [*network.talk(vehicle, station, 0.02)]
        critical = [
            network.traffic(*ends, 0.1, cls=Class.CRITICAL) for ends in ((vehicle, station), (station, vehicle))
        ]
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
