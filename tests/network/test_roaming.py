"""Addresses that change under traffic, honestly and by attackers."""

from __future__ import annotations

import pytest

from tests.network.attackers import Racer
from tests.network.network import Address, Drone, Flow, Network, share_a_session
from uavlinkd.core.constants import LEAST_ANSWER_S, PROBE_FAST_S
from uavlinkd.core.outputs import PathChanged
from uavlinkd.lab.mitm.radio import RadioSettings

BACK_WITHIN_S = 3.0
MISCHIEF: Address = ("198.51.100.66", 6666)


def _linked(network: Network, *, b_knows: bool = True, interval_s: float = 0.05) -> tuple[Drone, Drone]:
    a, b = network.add("a"), network.add("b", clock=2.0**32)
    a.knows(b, b.addresses)
    b.knows(a, a.addresses if b_knows else ())
    a.start()
    b.start()
    network.talk(a, b, interval_s)
    network.run_until(lambda: share_a_session(a, b), within_s=4)
    network.run(3)
    return a, b


def _flows(network: Network, a: Drone, b: Drone) -> tuple[Flow, Flow]:
    return network.flow(a, b), network.flow(b, a)


def _path_to(drone: Drone, other: Drone) -> Address:
    path = drone.peer(other).path
    assert path is not None
    return path.host, path.address[1]


@pytest.mark.parametrize("delay_s", [0.01, 0.1, 0.3])
def test_traffic_follows_an_address_change_within_a_round_trip(delay_s: float) -> None:
    """The new address is proven, the old one does not answer, then all traffic goes to the new one; no new keys."""
    proven_s = 0.06 + 3 * delay_s  # after the mover's next frame: the question and the answer
    suspect_s = PROBE_FAST_S + max(LEAST_ANSWER_S, 3 * 2 * delay_s)  # the old path: the next question, and its wait
    for seed in range(5):
        with Network(f"moves {delay_s} {seed}", RadioSettings(delay_s=delay_s)) as network:
            a, b = _linked(network, b_knows=False)
            handshakes = b.peer(a).traffic.handshakes
            begin = network.now
            a.move(("172.16.0.7", 40007))
            network.run(proven_s + suspect_s)
            back = network.now
            network.run(3)
            assert _path_to(b, a) == a.addresses[0]
            assert b.peer(a).traffic.handshakes == handshakes
            assert len(b.peer(a).paths.states) == 1
            changes = [event for at, event in b.outputs if at > begin and isinstance(event, PathChanged)]
            assert [(event.path.address, event.reason) for event in changes] == [(a.addresses[0], "unanswered")]
            for flow in _flows(network, a, b):
                assert not flow.lost(back, network.now - delay_s - 0.01)
            assert not network.flow(a, b).lost(begin, back)


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_nat_rebinding_under_traffic_is_followed(loss: float) -> None:
    """A NAT that forgets its mapping every five seconds: both directions work again within three seconds."""
    for seed in range(4):
        with Network(f"nat {loss} {seed}", RadioSettings(delay_s=0.05, loss=loss)) as network:
            a, b = _linked(network, b_knows=False)
            a.is_behind_nat = True
            for rebinding in range(6):
                a.move(("203.0.113.1", 50000 + rebinding))
                network.run(BACK_WITHIN_S)
                back = network.now
                network.run(2)
                for flow in _flows(network, a, b):
                    assert flow.first_delivery(back) < network.now, f"{flow.sender} to {flow.receiver}"
                assert _path_to(b, a) == a.addresses[0]


def test_both_ends_may_move_at_once_while_one_keeps_an_address() -> None:
    """Both ends change their address in the same instant; one has a second address that the other knows."""
    for seed in range(5):
        with Network(f"both move {seed}", RadioSettings(delay_s=0.05)) as network:
            a, b = network.add("a"), network.add("b", ("10.0.0.2", 5790), ("10.0.9.2", 5790))
            a.knows(b, b.addresses)
            b.knows(a, a.addresses)
            a.start()
            b.start()
            network.talk(a, b)
            network.run(5)
            a.move(("172.16.0.7", 40007))
            b.move(("172.16.0.8", 40008), ("10.0.9.2", 5790))
            network.run(BACK_WITHIN_S)
            back = network.now
            network.run(3)
            for flow in _flows(network, a, b):
                assert not flow.lost(back, network.now - 0.1)


def test_forwarding_from_a_third_address_does_not_attract_traffic() -> None:
    """Every datagram arrives first from an address that never answers: it gets challenges, and no frame."""
    for seed in range(5):
        with Network(f"mischief {seed}", RadioSettings(delay_s=0.02)) as network:
            a, b = _linked(network)
            racer = Racer(network, MISCHIEF, a, b, relays=False)
            network.radios_of[MISCHIEF, b.addresses[0]] = RadioSettings(delay_s=0.001)
            begin = network.now
            network.run(10)
            assert _path_to(b, a) == a.addresses[0]
            assert racer.attracted  # questions
            assert max(map(len, racer.attracted)) <= 43
            assert len(racer.attracted) <= 10 * 4 + 1
            for flow in _flows(network, a, b):
                assert not flow.lost(begin, network.now - 0.1)
