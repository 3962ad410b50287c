"""Frames by class between two daemons with two radios: what goes along which, and what is delivered."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import pytest

from tests.daemon.two_radios import End, Network, Radio
from tests.protocol import inside
from tests.samples import attitude, blank, command, heartbeat, manual_control
from uavlinkd.daemon.copies import BEGIN_LOSS
from uavlinkd.daemon.peer_output import STICKS_COPIED_S, PeerOutput
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.path_state import PathCondition, PathState

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


STICKS_PER_S = 50


def fly(pair: Network, seconds: float) -> Counter[int]:
    """The pilot's stick moves, and the vehicle reports. Returns the pilot's datagrams by radio."""
    pair.alpha.sent.clear()
    for number in range(round(seconds * STICKS_PER_S)):
        pair.alpha.send(manual_control(number))
        pair.bravo.send(attitude(number))
        pair.run(pair.now + 1 / STICKS_PER_S)
    return Counter(sent.radio for sent in pair.alpha.sent)


def test_stick_positions_are_copied_rarely_while_the_best_path_is_healthy() -> None:
    """A path that dies costs two in a row. As soon as that is seen, or while it loses some, each one is copied."""
    pair = network(FAST, SLOW)
    fly(pair, 2.1)
    assert fly(pair, 10.0)[1] < 10.0 * STICKS_PER_S / 2.5  # with probes
    died = pair.now
    pair.radios[0] = Radio(FAST.delay_s, loss=1.0)
    fly(pair, 0.5)
    assert fly(pair, 1.0)[1] >= STICKS_PER_S
    gaps = [later - earlier for earlier, later in pairwise(at for at in pair.bravo.delivered_at if at >= died - 0.2)]
    assert max(gaps) < STICKS_COPIED_S + 1 / STICKS_PER_S + SLOW.delay_s - FAST.delay_s
    pair.radios[0] = Radio(FAST.delay_s, loss=0.1)
    fly(pair, 20.0)
    assert fly(pair, 1.0)[1] >= STICKS_PER_S


OVERRIDE, SETPOINT = blank("RC_CHANNELS_OVERRIDE"), blank("SET_POSITION_TARGET_LOCAL_NED")


@pytest.mark.parametrize(
    ("frames", "radios"),
    [
        ([manual_control(2)], {0: 1}),
        ([OVERRIDE, manual_control(2)], {0: 1, 1: 1}),  # one of them was not copied yet
        ([manual_control(2), command(2)], {0: 1, 1: 1}),
        ([command(2)], {0: 1, 1: 1}),
        ([heartbeat(2)], {0: 1, 1: 1}),
        ([SETPOINT], {0: 1, 1: 1}),
    ],
)
def test_nothing_but_stick_positions_is_spared(frames: list[Frame], radios: dict[int, int]) -> None:
    """However soon it follows one of its flow."""
    pair = network(FAST, SLOW)
    for those in ([manual_control(1), command(1)], [manual_control(1)], [heartbeat(1)], [SETPOINT]):
        pair.alpha.send(*those)
    pair.alpha.sent.clear()
    pair.alpha.send(*frames)
    assert radios_of(pair.alpha, *frames) == {one.raw: radios for one in frames}


@pytest.mark.parametrize("sign", ["loss", "repair", "suspect"])
def test_no_stick_position_is_spared_while_the_best_path_is_not_healthy(
    sign: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also a path that is down gets a copy then: it may be the one that carries it."""
    pair = network(FAST, SLOW, SLOW)
    paths = pair.alpha.peer.paths
    best, _, last = paths.states
    inside.set_condition(last, PathCondition.DOWN, pair.now)
    if sign == "loss":
        monkeypatch.setattr(PathState, "loss_out", BEGIN_LOSS)
    elif sign == "repair":
        pair.alpha.link.output.repair.is_on = True
    else:
        inside.set_condition(best, PathCondition.SUSPECT, pair.now)
    inside.set_routes(paths, pair.now)
    pair.alpha.send(manual_control(1))
    pair.alpha.send(manual_control(2))
    assert set(radios_of(pair.alpha, manual_control(2))[manual_control(2).raw]) == {0, 1, 2}


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
    assert pair.alpha.link.output.copies.dropped.total() > 100


@pytest.mark.parametrize("is_removed", [True, False], ids=["removed", "changed by a reload"])
def test_peer_that_stops_waiting_lets_others_use_the_network(is_removed: bool) -> None:
    """Its frames waited in line for the modem. The other peer's frames are next, not behind it indefinitely."""
    pair = network(TELEMETRY_MODEM)
    budget = pair.alpha.budgets[0]
    alpha = pair.alpha
    other = PeerOutput(EgressSettings(), alpha.peer, alpha.node, alpha.budgets, lambda *_: None, pair.now)
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
