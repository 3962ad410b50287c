"""Frames by class between two daemons with two radios: what goes along which, and what is delivered."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from tests.daemon.two_radios import End, Network, Radio
from tests.samples import attitude, command, manual_control
from uavlinkd.daemon.pacer import Pacer
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.path_state import PathCondition

FAST, SLOW = Radio(0.02), Radio(0.1)


def network(*radios: Radio) -> Network:
    """Both ends have all their paths."""
    made = Network(radios)
    made.establish()
    for end in (made.alpha, made.bravo):
        end.sent.clear()
    return made


def radios_of(end: End, *frames: Frame) -> dict[bytes, Counter[int]]:
    """How many datagrams with each of these frames an end sent on each radio. Frames are readable in an envelope."""
    return {frame.raw: Counter(sent.radio for sent in end.sent if frame.raw in sent.datagram) for frame in frames}


RADIO_BITS_S = 9600
TELEMETRY_MODEM = Radio(0.15, budget_bits_s=RADIO_BITS_S)


def test_copies_that_wait_are_not_counted_as_lost_by_their_path() -> None:
    """The modem loses nothing: its probes show no loss, and the path is never suspect for it."""
    pair = network(FAST, TELEMETRY_MODEM)
    for number in range(1000):
        pair.alpha.send(manual_control(number), command(number))
        pair.run(pair.now + 0.02)
        modem = pair.alpha.peer.paths.states[1]
        assert modem.condition is PathCondition.USABLE
        assert modem.loss_out < 0.05
    assert pair.alpha.link.pacer.copies.dropped.total() > 100


@pytest.mark.parametrize("is_removed", [True, False], ids=["removed", "changed by a reload"])
def test_peer_that_stops_waiting_lets_others_use_the_network(is_removed: bool) -> None:
    """Its frames waited in line for the modem. The other peer's frames are next, not behind it indefinitely."""
    pair = network(TELEMETRY_MODEM)
    budget = pair.alpha.budgets[0]
    alpha = pair.alpha
    other = Pacer(EgressSettings(), alpha.peer, alpha.node, alpha.budgets, lambda *_: None, pair.now)
    other.follow(pair.now)
    budget.all.spend(1.1 * RADIO_BITS_S / 8, pair.now)
    pair.alpha.send(attitude(1))
    other.send([attitude(2)], pair.now, 0.0)
    other.send_waiting(pair.now)
    assert other.egress is not None
    assert other.egress.count == 1
    if is_removed:
        pair.alpha.link.leave(pair.now)
    else:
        config = replace(pair.alpha.link.config, egress=EgressSettings(budget_bits_s=RADIO_BITS_S))
        pair.alpha.link.change(config, pair.now)
    later = pair.now + 0.95
    assert budget.all.level(later) > 150
    assert other.egress.take(later) == [attitude(2)]
