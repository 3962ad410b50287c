"""An attacker that recorded everything replays it, at any time, to any drone, from any address."""

from __future__ import annotations

from collections import Counter
from itertools import permutations

from tests.network.attackers import Recorder
from tests.network.network import Drone, Network
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.settings import Link, Timers

FAST_REKEY = Link(timers=Timers(rekey_after_s=1.0, reject_after_s=6.0))


def _storm(network: Network, recorder: Recorder, per_s: float, duration_s: float) -> None:
    """Replay at random for a while: unchanged, to another drone, back to its sender, or from another address."""
    drones = list(network.drones.values())
    rng = network.rng

    def replay() -> None:
        datagram, source, destination = rng.choice(recorder.recorded)
        match rng.randrange(5):
            case 0:
                source, destination = destination, source
            case 1:
                destination = rng.choice(drones).addresses[0]
            case 2:
                source = ("198.51.100.1", 1024 + rng.randrange(60000))
            case 3:
                source, destination = rng.choice(drones).addresses[0], rng.choice(drones).addresses[0]
        network.inject(datagram, source, destination)

    for number in range(int(per_s * duration_s)):
        network.at(network.now + number / per_s, replay)


def _triangle(network: Network) -> tuple[Drone, Drone, Drone]:
    drones = network.add("a"), network.add("b"), network.add("c")
    for one, other in permutations(drones, 2):
        one.knows(other, other.addresses, FAST_REKEY)
    for drone in drones:
        drone.start()
    for one, other in permutations(drones, 2):
        network.traffic(one, other, 0.05)
    return drones


def test_replay_storm_delivers_nothing_twice_and_leaves_the_links_as_they_are() -> None:
    """500 replays a second against three linked drones: every frame once and in time, nothing lost."""
    with Network("storm 0", RadioSettings(delay_s=0.02)) as network:
        a, b, c = _triangle(network)
        recorder = Recorder(network)
        network.run(8)
        begin = network.now
        _storm(network, recorder, per_s=500, duration_s=10)
        network.run(10)
        for flow in network.flows.values():
            assert not flow.lost(begin, network.now - 0.1), f"{flow.sender} to {flow.receiver}"
            late = [n for n, at in flow.delivered.items() if flow.sent_at[n] > begin and at - flow.sent_at[n] > 0.03]
            assert not late
        for drone, others in ((a, (b, c)), (b, (a, c)), (c, (a, b))):
            copies = sum((drone.peer(other).traffic.drops for other in others), start=Counter[DropReason]())
            # An old envelope from the address of a peer is a late copy, from any other address a replay.
            assert copies[DropReason.REPLAYED] > 5
            assert copies[DropReason.LATE_COPY] > 5
