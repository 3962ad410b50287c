"""The figures of a link with several paths."""

from __future__ import annotations

import pytest

from tests.core.harness import AT_B, ELSEWHERE, KEY_B, PLAIN, Pair, of, quiet
from tests.link.test_peer_link import link_of
from tests.policies import TRUSTED
from uavlinkd.config import PeerAddress
from uavlinkd.config import PeerConfig as Peer
from uavlinkd.core.outputs import Transmit
from uavlinkd.core.settings import PeerSettings
from uavlinkd.link.peer_link import PeerLink, Rates
from uavlinkd.system.addresses import Address

ROUND_TRIP_S = 0.05


def flown(seconds: float, lost_each: int = 0) -> tuple[Pair, PeerLink]:
    """Alpha has a path that works and a dead one. Each ``lost_each``-th datagram to bravo is lost after a second."""
    pair = Pair(quiet(), quiet())
    config = Peer(
        PeerSettings("bravo", KEY_B.public, None, PLAIN), (PeerAddress(Address("192.0.2.2", 14600)),), TRUSTED
    )
    link = link_of(pair.a, config, lambda _: None)
    pair.a.node.set_paths(pair.a.peer, [AT_B, ELSEWHERE], 0.0)
    flight: list[tuple[float, bool, bytes]] = []  # when it arrives, whether at bravo
    sent = 0
    for step in range(round(seconds * 40)):
        now = step / 40
        arriving = [entry for entry in flight if entry[0] <= now]
        flight = [entry for entry in flight if entry[0] > now]
        outputs = [(pair.a, pair.a.timeout(now)), (pair.b, pair.b.timeout(now))]
        for _, is_to_b, datagram in arriving:
            side = pair.b if is_to_b else pair.a
            outputs.append((side, side.receive(datagram, now)))
        if pair.a.peer.is_up and step % 2:
            outputs.append((pair.a, pair.a.send(now)))
        for side, out in ((side, out) for side, outs in outputs for out in of(outs, Transmit)):
            if out.path == AT_B or side is pair.b:
                sent += side is pair.a
                if not (lost_each and side is pair.a and now > 1.0 and sent % lost_each == 0):
                    flight.append((now + ROUND_TRIP_S / 2, side is pair.a, out.datagram))
        if step % 40 == 0:
            link.measure(now)
    return pair, link


def test_figures_of_a_link_with_several_paths_are_those_of_the_path_in_use() -> None:
    """Probes along the dead path are lost, and RADIO_STATUS does not show it; a lossy path in use shows."""
    _, clean = flown(30.0)
    assert (clean.figures.loss_in, clean.figures.loss_out) == (0, 0)
    assert clean.figures.round_trip_s == pytest.approx(ROUND_TRIP_S, abs=0.03)
    _, lossy = flown(30.0, lost_each=4)
    assert lossy.figures.loss_out == pytest.approx(0.25, abs=0.1)


def test_probes_on_a_dead_path_are_not_in_the_figures_of_the_receiver() -> None:
    """It knows one path only, along which the other end reports."""
    pair, _ = flown(30.0)
    assert pair.b.session.missing(30.0) > 10
    assert pair.b.peer.missing(30.0) == 0


def test_rates_of_paths_that_come_and_go() -> None:
    """A new path has none, one that is gone is forgotten, and a clock that stands still divides nothing by zero."""
    pair = Pair().establish()
    (state,) = pair.a.peer.paths.states
    rates = Rates(0.0)
    rates.measure(pair.a.peer, 1.0)
    assert rates.of(state) == (0.0, 0.0)
    state.bytes_received += 100
    state.bytes_sent += 50
    rates.measure(pair.a.peer, 1.0)
    rates.measure(pair.a.peer, 3.0)
    assert rates.of(state) == (50.0, 25.0)
    rates.measure(pair.b.peer, 4.0)
    assert rates.of(state) == (0.0, 0.0)
