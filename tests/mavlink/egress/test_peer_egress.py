"""Frames of a peer wait in one queue: urgent ones for any of its networks, the others for the best path's."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.links import SHAPE, Link
from tests.samples import attitude, battery, command, frame, heartbeat, log_data, parameter, raws
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.frames import Frame

NO_BUDGET = EgressSettings()
SLOW_BITS_S, FAST_BITS_S = 8000, 80_000


def status_text(number: int) -> Frame:
    """A critical event that is not urgent."""
    return frame(mavlink.MAVLink_statustext_message(6, f"text {number}".encode()))


class Radio(Link):
    """A peer with these networks, the best path's first."""

    def __init__(self, settings: EgressSettings, *networks: Bucket | None) -> None:
        super().__init__(settings, SHAPE, *networks)

    def of(self, *frames: Frame) -> list[bytes]:
        """Those of these frames that were sent."""
        return [raw for _, raw in self.sent if raw in raws(frames)]


def test_frames_leave_in_order_whatever_their_class() -> None:
    """While there is room, and after a coalescing delay, which an urgent frame ends for all."""
    frames = [attitude(1), log_data(1), command(1), attitude(2), status_text(1), parameter(1)]
    for radio in (
        Radio(NO_BUDGET, Bucket(FAST_BITS_S, 0.0), None),
        Radio(EgressSettings(coalesce_s=0.1), None, None),
    ):
        radio.put(*frames[:2], now=0.0)
        radio.put(*frames[2:], now=0.05)
        assert [raw for _, raw in radio.sent] == raws(frames)


class Stream(Bucket):
    """A connection by TLS that takes nothing until it is opened."""

    keeps_order = True

    def level(self, now: float) -> float:
        return super().level(now) if now >= 0.5 else 0.0


def test_frames_wait_in_order_for_room_in_a_stream() -> None:
    """None replaces or overtakes another one, however many wait."""
    radio = Radio(NO_BUDGET, Stream(FAST_BITS_S, 0.0))
    frames = [
        one for n in range(20) for one in (attitude(n), log_data(n), command(n), attitude(n + 100), heartbeat(n))
    ]
    for number, one in enumerate(frames):
        radio.put(one, now=0.004 * number)
    assert not radio.sent
    radio.run(2.0)
    assert [raw for _, raw in radio.sent] == raws(frames)


def test_urgent_frame_goes_when_the_first_network_has_room() -> None:
    """The best path's network is exhausted, the second one is not. All other frames wait for the best one."""
    best, second = Bucket(SLOW_BITS_S, 0.0), Bucket(FAST_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, best, second)
    best.spend(1000, 0.0)
    radio.put(attitude(1), command(1), status_text(1), heartbeat(1), now=0.0)
    assert [raw for _, raw in radio.sent] == raws([command(1), heartbeat(1)])
    radio.run(2.0)
    assert [raw for _, raw in radio.sent][2:] == raws([attitude(1), status_text(1)])


def test_network_without_a_budget_always_has_room_for_urgent_frames() -> None:
    """The best path's network is far over its budget."""
    best = Bucket(SLOW_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, best, None)
    best.spend(2000, 0.0)
    for number in range(20):
        radio.put(command(number), attitude(number), now=0.0)
    assert [raw for _, raw in radio.sent] == raws(map(command, range(20)))


def test_two_peers_share_the_budget_of_a_network() -> None:
    """What one sends is missing for the other: together they never exceed it."""
    network = Bucket(SLOW_BITS_S, 0.0)
    radios = [Radio(NO_BUDGET, network), Radio(NO_BUDGET, network)]
    seconds = 30
    for tick in range(20 * seconds):
        for radio in radios:
            radio.put(attitude(tick), battery(tick, 1), now=tick / 20)
            radio.run(tick / 20)
    wire = [SHAPE.overhead + sum(map(len, batch)) for radio in radios for _, batch in radio.envelopes]
    assert 0.9 * SLOW_BITS_S / 8 * seconds < sum(wire) <= SLOW_BITS_S / 8 * (seconds + 0.25)
    assert network.demand(seconds) > 1
    assert radios[0].egress.demand(seconds) == network.demand(seconds)
    first, second = (sum(len(raw) for _, raw in radio.sent) for radio in radios)
    assert first == pytest.approx(second, rel=0.1)


@pytest.mark.parametrize("offered", [attitude, log_data], ids=["stream", "bulk"])
def test_commands_pass_a_flood_of_another_class(offered: Callable[[int], Frame]) -> None:
    """Each leaves within the time that the network needs for one envelope of the flood."""
    radio = Radio(NO_BUDGET, Bucket(SLOW_BITS_S, 0.0))
    for tick in range(400):
        now = tick / 40
        radio.put(*[offered(10 * tick + n) for n in range(5)], now=now)
        if tick % 20 == 0:
            radio.put(command(tick), now=now)
        radio.run(now)
    radio.run(11.0)
    sent_at = {raw: now for now, raw in radio.sent}
    waits = [sent_at[command(tick).raw] - tick / 40 for tick in range(0, 400, 20)]
    assert max(waits) <= (SHAPE.overhead + SHAPE.payload_limit) * 8 / SLOW_BITS_S
    assert radio.egress.totals[EgressDrop.CLOSED] == 0


def test_stream_and_bulk_have_equal_shares_while_both_wait() -> None:
    """A log download leaves half of a slow radio to telemetry, and the other way round."""
    radio = Radio(NO_BUDGET, Bucket(SLOW_BITS_S, 0.0))
    for tick in range(600):
        radio.put(attitude(tick), battery(tick, tick % 3), log_data(tick), log_data(1000 + tick), now=tick / 20)
        radio.run(tick / 20)
    parts = {log_data(number).raw for number in range(1600)}
    of_log = sum(len(raw) for _, raw in radio.sent if raw in parts)
    assert of_log / sum(len(raw) for _, raw in radio.sent) == pytest.approx(0.5, abs=0.03)


def test_change_of_paths_keeps_what_waits_with_its_age() -> None:
    """Another path becomes the best one while frames wait. They leave in order, or become too old."""
    best = Bucket(SLOW_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, best)
    best.spend(1000, 0.0)
    radio.put(parameter(1), attitude(1), now=0.0)
    radio.egress.set_networks([best, best])
    radio.put(parameter(2), attitude(2), now=0.3)
    radio.egress.set_networks([best])
    radio.put(parameter(3), now=0.4)
    assert radio.egress.count == 4
    assert radio.egress.totals == {EgressDrop.THINNED: 1}
    radio.run(1.0)
    sent = [raw for _, raw in radio.sent]
    assert [raw for raw in sent if raw != attitude(2).raw] == raws([parameter(1), parameter(2), parameter(3)])
    radio.run(10.0)
    assert radio.egress.count == 0


def test_report_needs_room_and_no_waiting_frames() -> None:
    """As with one path."""
    network = Bucket(SLOW_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, network)
    assert radio.egress.has_room(50, 0.0)
    network.spend(1000, 0.0)
    assert not radio.egress.has_room(50, 0.0)


MAKERS = (attitude, command, parameter, log_data, heartbeat, status_text)


@given(
    st.lists(st.tuples(st.sampled_from(MAKERS), st.floats(0, 0.2)), max_size=60),
    st.sampled_from([(SLOW_BITS_S,), (SLOW_BITS_S, FAST_BITS_S), (None,), (SLOW_BITS_S, None)]),
)
def test_each_frame_leaves_once_and_in_the_order_of_its_flow(
    offers: list[tuple[Callable[[int], Frame], float]], budgets: tuple[int | None, ...]
) -> None:
    """Whatever is offered."""
    networks = [None if budget is None else Bucket(budget, 0.0) for budget in budgets]
    radio = Radio(NO_BUDGET, *networks)
    now, offered = 0.0, list[bytes]()
    for number, (maker, pause) in enumerate(offers):
        now += pause
        radio.run(now)
        made = maker(number)
        offered.append(made.raw)
        radio.put(made, now=now)
    radio.run(now + 60)
    sent = [raw for _, raw in radio.sent]
    assert len(sent) == len(set(sent))
    assert len(sent) + radio.egress.totals.total() == len(offered)
    for make in MAKERS:
        of_flow = [offered.index(raw) for raw in sent if raw in {make(n).raw for n in range(len(offers))}]
        assert all(early < late for early, late in pairwise(of_flow))
