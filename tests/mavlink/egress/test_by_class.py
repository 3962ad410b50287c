"""Frames of a peer with several paths wait by class, each class for the budget of its own networks."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.links import CLASS_OF, SHAPE, Link
from tests.samples import attitude, battery, command, frame, heartbeat, log_data, parameter, raws
from uavlinkd.core.constants import CRITICAL_ENVELOPE_LIMIT
from uavlinkd.core.settings import Class
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.egress.by_class import split_by_class
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import Frame

NO_BUDGET = EgressSettings()
SLOW_BITS_S, FAST_BITS_S = 8000, 80_000


def status_text(number: int) -> Frame:
    """A critical event that is not urgent."""
    return frame(mavlink.MAVLink_statustext_message(6, f"text {number}".encode()))


class Radio(Link):
    """A peer with these networks, the best path's first."""

    def __init__(self, settings: EgressSettings, *networks: Bucket | None, is_split: bool = True) -> None:
        super().__init__(settings, SHAPE, *networks, is_split=is_split)

    @property
    def by_class(self) -> list[tuple[float, Class, list[bytes]]]:
        """The envelopes: when each was sent, its class, its frames."""
        return [(now, cls, batch) for (now, batch), cls in zip(self.envelopes, self.classes, strict=True)]

    def of(self, cls: Class) -> list[bytes]:
        """The frames that were sent in envelopes of this class."""
        return [raw for _, sent_as, batch in self.by_class if sent_as is cls for raw in batch]

    def size(self, cls: Class) -> int:
        """Bytes sent in envelopes of this class."""
        return sum(map(len, self.of(cls)))


def test_batch_is_split_critical_first_and_keeps_the_order_within_a_class() -> None:
    """One batch of a wake-up, with all classes mixed."""
    batch = [attitude(1), log_data(1), command(1), attitude(2), heartbeat(1), parameter(1)]
    assert split_by_class(batch, CLASS_OF, 0.0) == [
        (Class.CRITICAL, [command(1), heartbeat(1)]),
        (Class.STREAM, [attitude(1), attitude(2)]),
        (Class.BULK, [log_data(1), parameter(1)]),
    ]
    assert split_by_class([command(1)], CLASS_OF, 0.0) == [(Class.CRITICAL, [command(1)])]


def test_together_frames_share_envelopes_whatever_their_class() -> None:
    """A peer with one path, on a network with a budget."""
    radio = Radio(NO_BUDGET, Bucket(FAST_BITS_S, 0.0), is_split=False)
    radio.put(attitude(1), command(1), parameter(1), now=0.0)
    ((_, batch),) = radio.envelopes
    assert len(batch) == 3


def test_coalescing_waits_for_each_class_alone() -> None:
    """A command leaves at once. It takes no attitude along, because that belongs in another envelope."""
    radio = Radio(EgressSettings(coalesce_s=0.1), None)
    radio.put(attitude(1), command(1), now=0.0)
    radio.put(attitude(2), now=0.05)
    radio.run(1.0)
    assert [(now, cls, len(batch)) for now, cls, batch in radio.by_class] == [
        (0.0, Class.CRITICAL, 1),
        (0.1, Class.STREAM, 2),
    ]


def test_envelope_has_one_class_and_critical_ones_are_short() -> None:
    """Of many frames of all classes."""
    radio = Radio(NO_BUDGET, Bucket(1e9, 0.0))
    frames = [make(n) for n in range(40) for make in (attitude, command, log_data, status_text)]
    radio.put(*frames, now=0.0)
    assert sorted(raw for _, raw in radio.sent) == sorted(raws(frames))
    by_raw = {made.raw: CLASS_OF(made, 0.0) for made in frames}
    for _, cls, batch in radio.by_class:
        assert {by_raw[raw] for raw in batch} == {cls}
        if cls is Class.CRITICAL:
            assert SHAPE.seal_bytes + sum(map(len, batch)) <= CRITICAL_ENVELOPE_LIMIT


def test_critical_frame_goes_when_the_first_network_has_room() -> None:
    """The best path's network is exhausted, the second one is not. The stream waits for the best one."""
    best, second = Bucket(SLOW_BITS_S, 0.0), Bucket(FAST_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, best, second)
    best.spend(1000, 0.0)
    radio.put(command(1), attitude(1), status_text(1), now=0.0)
    assert len(radio.of(Class.CRITICAL)) == 2
    assert radio.of(Class.STREAM) == []
    radio.run(2.0)
    assert radio.of(Class.STREAM) == [attitude(1).raw]


def test_network_without_a_budget_always_has_room_for_critical_frames() -> None:
    """The best path's network is far over its budget."""
    best = Bucket(SLOW_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, best, None)
    best.spend(2000, 0.0)
    for number in range(20):
        radio.put(command(number), attitude(number), now=0.0)
    assert len(radio.of(Class.CRITICAL)) == 20
    assert radio.of(Class.STREAM) == []


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
    assert radio.size(Class.STREAM) / radio.size(Class.BULK) == pytest.approx(1, abs=0.1)


def test_stream_that_comes_while_bulk_is_in_line_goes_first() -> None:
    """Both wait for the same budget. In line one behind the other, neither would leave."""
    network = Bucket(SLOW_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, network)
    network.spend(250, 0.0)
    radio.put(parameter(1), now=0.0)
    radio.put(attitude(1), now=0.01)
    radio.run(1.0)
    assert [cls for _, cls, _ in radio.by_class] == [Class.STREAM, Class.BULK]
    assert radio.egress.queued_frames == 0


def test_change_of_paths_keeps_what_waits_with_its_age() -> None:
    """A second path becomes usable and fails again while frames wait. They leave in order, or become too old."""
    best = Bucket(SLOW_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, best, is_split=False)
    best.spend(1000, 0.0)
    radio.put(parameter(1), attitude(1), now=0.0)
    radio.is_split = True
    radio.put(parameter(2), attitude(2), now=0.3)
    radio.is_split = False
    radio.put(parameter(3), now=0.4)
    assert radio.egress.queued_frames == 4
    assert radio.egress.totals == {EgressDrop.THINNED: 1}
    radio.run(1.0)
    sent = [raw for _, raw in radio.sent]
    assert [raw for raw in sent if raw != attitude(2).raw] == raws([parameter(1), parameter(2), parameter(3)])
    radio.run(10.0)
    assert radio.egress.queued_frames == 0


def test_waiting_frames_of_a_lost_peer_are_dropped() -> None:
    """Of all classes."""
    network = Bucket(SLOW_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, network)
    network.spend(1000, 0.0)
    radio.put(attitude(1), command(1), log_data(1), now=0.0)
    radio.egress.clear(0.1)
    assert radio.egress.totals == {EgressDrop.CLOSED: 3}
    assert radio.egress.queued_frames == 0


def test_report_needs_room_and_no_waiting_frames() -> None:
    """As with one path."""
    network = Bucket(SLOW_BITS_S, 0.0)
    radio = Radio(NO_BUDGET, network)
    assert radio.egress.has_room(50, 0.0)
    network.spend(1000, 0.0)
    assert not radio.egress.has_room(50, 0.0)


MAKERS = (attitude, command, parameter, log_data, heartbeat, status_text)


@given(
    st.lists(st.tuples(st.sampled_from(MAKERS), st.floats(0, 0.2), st.booleans()), max_size=60),
    st.sampled_from([(SLOW_BITS_S,), (SLOW_BITS_S, FAST_BITS_S), (None,), (SLOW_BITS_S, None)]),
)
def test_each_frame_leaves_once_and_in_the_order_of_its_flow(
    offers: list[tuple[Callable[[int], Frame], float, bool]], budgets: tuple[int | None, ...]
) -> None:
    """Whatever is offered, and however often the number of paths changes."""
    networks = [None if budget is None else Bucket(budget, 0.0) for budget in budgets]
    radio = Radio(NO_BUDGET, *networks)
    now, offered = 0.0, list[bytes]()
    for number, (maker, pause, is_split) in enumerate(offers):
        now += pause
        radio.run(now)
        radio.is_split = is_split
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
