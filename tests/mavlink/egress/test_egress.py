"""What waits for a slow link: coalescing, the budget on the wire, who goes first, and what is dropped."""

from __future__ import annotations

import os
import random
from collections import Counter
from itertools import pairwise
from math import inf
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.samples import (
    ID,
    MAKERS,
    SHAPE,
    SLOW,
    Link,
    attitude,
    battery,
    command,
    every,
    flow_of,
    frame,
    heartbeat,
    id_of,
    parameter,
    play,
    raws,
)
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.egress.bucket import BURST_S
from uavlinkd.mavlink.egress.budgeted import Egress, EgressSettings, EnvelopeShape
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.flows import FlowKey
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.headers import Header

os.environ.setdefault("MAVLINK20", "1")


# Without a budget: coalescing.


def test_frames_share_an_envelope_after_the_delay() -> None:
    """Frames wait from the first of them for the delay, not longer, and go together in their order."""
    link = Link(EgressSettings(coalesce_s=0.05))
    frames = [attitude(1), parameter(1), battery(1, 0), attitude(2)]
    for n, waiting in enumerate(frames):
        link.put(waiting, now=n * 0.01)
    assert not link.sent
    assert link.egress.next_deadline() == 0.05
    assert link.egress.take(0.0499) == []
    link.flush(0.05)
    assert link.envelopes == [(0.05, raws(frames))]
    assert link.egress.next_deadline() == inf


def test_full_envelope_does_not_wait() -> None:
    """As soon as an envelope's worth is there it goes, and what does not fit goes on waiting."""
    link = Link(EgressSettings(coalesce_s=0.5), EnvelopeShape(payload_limit=300))
    frames = [attitude(n) for n in range(10)]  # 40 bytes each: seven fit, the eighth makes it full
    for waiting in frames:
        link.put(waiting, now=0.1)
    assert link.envelopes == [(0.1, raws(frames[:7]))]
    assert link.egress.next_deadline() == pytest.approx(0.6)
    link.run(1.0)
    assert [raw for _, raw in link.sent] == raws(frames)


def test_newer_state_does_not_wait_again() -> None:
    """Two states arrive more often than the coalescing delay ends, and the budget is short. The newest go in time."""
    link = Link(EgressSettings(budget_bits_s=4000, coalesce_s=0.25))
    for n in range(200):
        link.put(attitude(n), now=n * 0.05)
    times = [at for at, _ in link.envelopes]
    assert max(later - earlier for earlier, later in pairwise(times)) < 0.5


def test_urgent_frame_ends_the_wait() -> None:
    """A command goes at once and takes along what waits, behind what came before it."""
    link = Link(EgressSettings(coalesce_s=0.5))
    link.put(attitude(1), now=0.0)
    link.put(command(1), now=0.1)
    assert link.names() == ["ATTITUDE", "COMMAND_LONG"]
    assert [now for now, _ in link.envelopes] == [0.1]


def test_nothing_is_thinned_without_a_budget() -> None:
    """Coalescing alone drops nothing and keeps the order, whatever the rate."""
    link = Link(EgressSettings(coalesce_s=0.1))
    frames = [attitude(n) for n in range(500)]
    play(link, [(n * 0.002, offered) for n, offered in enumerate(frames)], until=2.0)
    assert [raw for _, raw in link.sent] == raws(frames)
    assert not link.egress.totals
    assert all(now - link.offered[raw] <= 0.1 + 1e-9 for now, raw in link.sent)


# The budget.


def test_idle_link_sends_at_once_and_in_order() -> None:
    """While the bucket covers what there is, nothing waits and nothing is reordered or thinned."""
    link = Link(SLOW)
    frames = [attitude(1), battery(1, 0), heartbeat(1), attitude(2)]
    link.egress.put(frames, 0.0)
    assert link.egress.take(0.0) == frames


def test_core_traffic_counts() -> None:
    """What the core sends empties the bucket, IP and UDP header included, and frames wait for it."""
    link = Link(SLOW)
    link.transmit(600, now=0.0)
    link.put(heartbeat(1), now=0.0)
    assert not link.sent
    # 331 bytes are in the bucket (one largest frame in an envelope); 628 went; 72 are needed at 500 bytes a second.
    due = (628 - 331 + 72) / 500
    assert link.egress.next_deadline() == pytest.approx(due)
    link.run(due - 0.01)
    assert not link.sent
    link.run(due + 0.01)
    assert link.names() == ["HEARTBEAT"]


def test_debt_after_an_outage_is_bounded() -> None:
    """Minutes of unanswered handshakes silence a link that is back for a second and one of them, no longer."""
    link = Link(SLOW)
    for n in range(200):
        link.transmit(1400, now=n * 1.5)
    link.put(heartbeat(1), now=300.0)
    assert link.egress.next_deadline() - 300.0 <= (500 + 1428 + 72) / 500


def test_largest_frame_passes_the_smallest_budget() -> None:
    """A frame that costs more than a second of budget still goes when the bucket is full."""
    link = Link(EgressSettings(budget_bits_s=1200))
    data = list(range(1, 252))
    link.put(frame(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, data)), now=0.0)
    assert link.names() == ["FILE_TRANSFER_PROTOCOL"]


def test_shape_may_change() -> None:
    """From the moment a path is IPv6, its longer header counts."""
    egress = Egress(SLOW, 0.0, SHAPE)
    egress.shape = EnvelopeShape(carrier_bytes=48)
    assert egress.shape.overhead == 23 + 48
    egress.spend(331 - 48, 0.0)
    egress.put([heartbeat(1)], 0.0)
    assert egress.next_deadline() == pytest.approx((21 + 23 + 48) / 500)


def fill(link: Link, now: float) -> None:
    """Empty the bucket, so that what comes has to wait."""
    link.transmit(331 - 28, now)


def test_newest_state_replaces_the_older() -> None:
    """While the budget is short, of one state of one sender only the newest waits."""
    link = Link(SLOW)
    fill(link, 0.0)
    link.put(*(attitude(n) for n in range(5)), *(attitude(n, system=2) for n in range(5)), now=0.0)
    assert link.egress.queued_frames == 2
    assert link.egress.totals == {EgressDrop.THINNED: 8}
    link.run(1.0)
    assert {raw for _, raw in link.sent} == {attitude(4).raw, attitude(4, system=2).raw}


def test_instances_do_not_replace_one_another() -> None:
    """Two batteries of one vehicle are two states, and so are setpoints for two vehicles."""
    link = Link(SLOW)
    fill(link, 0.0)

    def setpoint(number: int, target: int) -> Frame:
        values = (0.0,) * 9
        return frame(
            mavlink.MAVLink_set_position_target_local_ned_message(number, target, 1, 1, 0, *values, 1.0, 1.0), 255
        )

    link.put(*(battery(n, n % 2) for n in range(6)), *(setpoint(n, 1 + n % 2) for n in range(6)), now=0.0)
    link.run(1.0)
    sent = {raw for _, raw in link.sent}
    assert sent == {battery(4, 0).raw, battery(5, 1).raw, setpoint(4, 1).raw, setpoint(5, 2).raw}


def test_events_are_never_replaced() -> None:
    """Parameters wait in their order; none replaces another."""
    link = Link(SLOW)
    fill(link, 0.0)
    frames = [parameter(n) for n in range(8)]
    link.put(*frames, now=0.0)
    link.run(1.0)
    assert [raw for _, raw in link.sent] == raws(frames)


def test_unknown_messages_are_events() -> None:
    """What the dialect knows otherwise may mean anything: none of it is taken to replace another."""
    link = Link(SLOW)
    fill(link, 0.0)
    strangers = []
    for n in range(4):
        known = attitude(n)
        header = known.header
        strangers.append(Frame(known.raw, Header(header.msgid, header.system, header.component, is_known=False)))
    link.put(*strangers, now=0.0)
    assert link.egress.queued_frames == 4


def test_commands_of_one_sender_keep_their_order() -> None:
    """Arming stays before taking off, though one is COMMAND_LONG and the other COMMAND_INT."""
    link = Link(SLOW)
    fill(link, 0.0)
    frames = []
    for n in range(3):
        frames.append(command(n))
        frames.append(frame(mavlink.MAVLink_command_int_message(1, 1, 6, 22, 0, 0, n, 1, 1, 1, 5, 5, 9.5), 255))
    link.put(*frames, now=0.0)
    link.run(1.0)
    assert [raw for _, raw in link.sent] == raws(frames)


def test_flood_of_commands_leaves_room_for_heartbeats() -> None:
    """A client that floods commands delays another's heartbeat by a turn, no more."""
    link = Link(SLOW)
    offers = [*every(0.005, command, 10.0), *every(1.0, heartbeat, 10.0, start=0.5)]
    play(link, offers, until=11.0)
    sent_at = {raw: now for now, raw in link.sent}
    assert max(sent_at[heartbeat(n).raw] - (0.5 + n) for n in range(9)) <= 0.6
    assert link.egress.totals.keys() <= {EgressDrop.STALE, EgressDrop.OVERFLOW}


def test_parameters_and_telemetry_share_the_budget() -> None:
    """While both wait, parameters and telemetry get about the same number of bytes."""
    link = Link(SLOW)
    offers = every(0.01, parameter, 30.0, start=0.003)
    for system in range(1, 13):
        offers += every(0.05, lambda n, system=system: attitude(n, system), 30.0)  # type: ignore[misc]
    play(link, offers, until=30.0)
    sizes: Counter[str] = Counter()
    for _, raw in link.sent:
        sizes[name_of(id_of(raw))] += len(raw)
    assert sizes["ATTITUDE"] == pytest.approx(sizes["PARAM_VALUE"], rel=0.1)


def test_slow_states_are_not_starved_by_fast_ones() -> None:
    """A state that comes every other second gets its share among thirty that come thirty times as often."""
    link = Link(SLOW)
    offers = every(2.0, lambda n: battery(n, 0), 60.0, start=1.0)
    for system in range(2, 32):
        offers += every(0.07, lambda n, system=system: attitude(n, system), 60.0)  # type: ignore[misc]
    play(link, offers, until=61.0)
    shares = Counter((id_of(raw), raw[5]) for _, raw in link.sent)
    assert len(shares) == 31
    # A fast one has a frame ready whenever its turn comes. The slow one's is a second too old in half of the turns.
    assert shares[ID["BATTERY_STATUS"], 1] >= min(shares.values()) * 0.6
    times = [1.0, *(now for now, raw in link.sent if id_of(raw) == ID["BATTERY_STATUS"]), 60.0]
    assert max(late - early for early, late in pairwise(times)) <= 8.0


def test_invented_flows_do_not_displace_the_known() -> None:
    """A client that makes up a new name for each value cannot keep a state that was there from being sent."""
    link = Link(SLOW)
    offers = every(0.1, attitude, 30.0)
    offers += every(
        0.005, lambda n: frame(mavlink.MAVLink_named_value_float_message(n, f"n{n}".encode(), 1.5), 9), 30.0
    )
    play(link, offers, until=30.0)
    times = [now for now, raw in link.sent if id_of(raw) == ID["ATTITUDE"]]
    assert max(late - early for early, late in pairwise([*times, 30.0])) <= 4.0


def test_clear_drops_all_that_waits() -> None:
    """Once a peer is gone nothing of it waits, and all is counted."""
    egress = Egress(EgressSettings(coalesce_s=0.1), 0.0)
    egress.put([attitude(1), parameter(1)], 0.0)
    egress.clear(0.05)
    assert (egress.queued_frames, egress.queued_bytes, egress.next_deadline()) == (0, 0, inf)
    assert egress.totals == {EgressDrop.CLOSED: 2}
    assert egress.take(0.2) == []


@pytest.mark.parametrize(
    "options",
    [{"budget_bits_s": -1}, {"coalesce_s": -0.1}, {"max_age_s": 0.0}, {"coalesce_s": 1.0, "max_age_s": 1.0}],
)
def test_impossible_settings_are_refused(options: dict[str, Any]) -> None:
    """Nothing negative, and a frame must not be stale before coalescing ends."""
    with pytest.raises(ValueError, match="no such way"):
        EgressSettings(**options)


def test_neither_budget_nor_delay_needs_no_egress() -> None:
    """The daemon sends straight on where there is neither; there nothing could wait."""
    assert not EgressSettings().is_needed
    assert EgressSettings(budget_bits_s=1).is_needed
    assert EgressSettings(coalesce_s=0.01).is_needed


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    budget=st.sampled_from([0, 1000, 4000, 64_000, 1_000_000]),
    coalesce=st.sampled_from([0.0, 0.02, 0.3]),
    limit=st.sampled_from([281, 400, 1200]),
)
def test_whatever_happens_the_rules_hold(seed: int, budget: int, coalesce: float, limit: int) -> None:
    """Sent at most once, never late, whole envelopes only, in order, all accounted for, and within the budget."""
    rng = random.Random(seed)
    shape = EnvelopeShape(payload_limit=limit)
    link = Link(EgressSettings(budget_bits_s=budget, coalesce_s=coalesce), shape)
    egress = link.egress
    now = 0.0
    core = 0
    for n in range(120):
        now += rng.choice((0.0, 0.001, 0.02, 0.3, 1.2))
        if rng.random() < 0.7:
            link.run(now)
        link.put(*(make(n) for make in MAKERS if rng.random() < 0.4), now=now)
        if rng.random() < 0.05:
            core += 100 + shape.carrier_bytes
            link.transmit(100, now)
    link.run(now + 5)
    assert len(link.offered) == len(link.sent) + egress.totals.total() + egress.queued_frames
    assert len({raw for _, raw in link.sent}) == len(link.sent)
    assert all(raw in link.offered and at - link.offered[raw] <= 1.0 for at, raw in link.sent)
    assert all(sum(map(len, batch)) <= limit for _, batch in link.envelopes)
    number = {raw: n for n, raw in enumerate(link.offered)}
    last: dict[FlowKey, int] = {}
    for _, raw in link.sent:
        flow = flow_of(raw)
        assert last.get(flow, -1) < number[raw]
        last[flow] = number[raw]
    if not budget:
        sent = {raw for _, raw in link.sent}
        assert [raw for _, raw in link.sent] == [raw for raw in link.offered if raw in sent]
    else:
        burst = max(budget / 8 * BURST_S, shape.overhead + 280)
        level, before = 0.0, 0.0
        for at, size in link.wire:
            level = max(0.0, level - (at - before) * budget / 8) + size
            before = at
            assert level <= burst + core + 1
    assert egress.queued_frames == 0
    assert egress.next_deadline() == inf
