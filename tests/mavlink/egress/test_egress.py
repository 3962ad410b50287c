"""What waits for a slow link: coalescing, the budget on the wire, who goes first, and what is dropped."""

from __future__ import annotations

import random
from collections import Counter
from functools import partial
from itertools import pairwise
from math import inf

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.links import MAKERS, SLOW, Link, every, flow_of, id_of, play
from tests.samples import ID, attitude, battery, command, frame, heartbeat, parameter, raws, read
from uavlinkd.mavlink.dialect import Lane
from uavlinkd.mavlink.egress.bucket import BURST_S
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.egress.peer_egress import MAX_FLOWS, MIN_LANE_BYTES, EgressSettings, EnvelopeShape
from uavlinkd.mavlink.flows import FlowKey

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


def test_urgent_frame_ends_the_wait() -> None:
    """A command goes at once and takes along what waits, behind what came before it."""
    link = Link(EgressSettings(coalesce_s=0.5))
    link.put(attitude(1), now=0.0)
    link.put(command(1), now=0.1)
    assert link.names() == ["ATTITUDE", "COMMAND_LONG"]
    assert [now for now, _ in link.envelopes] == [0.1]


# The budget.


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


def test_all_states_are_thinned_alike() -> None:
    """No state starves: each that is offered often enough goes as often as any other, give or take."""
    link = Link(SLOW)
    periods = {system: (0.05, 0.1, 0.2, 0.5)[system % 4] for system in range(1, 13)}
    offers = [one for system, s in periods.items() for one in every(s, partial(attitude, system=system), 30.0)]
    play(link, offers, until=30.0)
    counts = Counter(read(raw).header.system for _, raw in link.sent)
    assert len(counts) == 12
    assert max(counts.values()) - min(counts.values()) <= 3, counts


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


# Bounds in age, in bytes and in memory.


@pytest.mark.parametrize("settings", [EgressSettings(coalesce_s=0.5), EgressSettings(4000, coalesce_s=0.5)])
@pytest.mark.parametrize(("taken_at", "sent"), [(1.0, 1), (1.001, 0)])
def test_frame_at_the_age_limit_goes_and_a_later_one_does_not(
    settings: EgressSettings, taken_at: float, sent: int
) -> None:
    """A frame leaves at max_age_s exactly, and is dropped as stale just after."""
    link = Link(settings)
    link.put(attitude(1), now=0.0)
    link.flush(taken_at)
    assert len(link.sent) == sent
    assert link.egress.totals == ({} if sent else {EgressDrop.STALE: 1})


@pytest.mark.parametrize("settings", [EgressSettings(coalesce_s=0.1), EgressSettings(4000, coalesce_s=0.1)])
def test_fresh_frames_beside_stale_ones_and_what_waits_for_a_lost_peer(settings: EgressSettings) -> None:
    """After a pause of the process a command leaves, and not the attitude beside it. Then the peer is lost."""
    link = Link(settings)
    link.put(attitude(1), now=0.0)
    link.put(heartbeat(2), now=1.5)
    assert [raw for _, raw in link.sent] == [heartbeat(2).raw]
    link.put(attitude(3), parameter(1), now=1.6)
    link.egress.clear()
    assert link.egress.totals == {EgressDrop.STALE: 1, EgressDrop.CLOSED: 2}
    assert (link.egress.count, link.egress.next_deadline()) == (0, inf)


def test_lanes_are_bounded_and_drop_the_oldest() -> None:
    """One flow holds half of its lane, many senders together all of it; other lanes are untouched."""
    link = Link(SLOW)
    link.transmit(4000, 0.0)
    frames = [parameter(n) for n in range(500)]
    link.put(*frames, now=0.0)
    egress = link.egress
    assert MIN_LANE_BYTES / 2 - 50 <= egress.lanes.size <= MIN_LANE_BYTES / 2
    kept = egress.count
    assert link.egress.totals == {EgressDrop.OVERFLOW: 500 - kept}
    link.put(heartbeat(1), now=0.0)
    assert raws(waiting.frame for waiting in egress.lanes.pop_all()) == raws([*frames[-kept:], heartbeat(1)])
    for n in range(60):
        pings = [frame(mavlink.MAVLink_ping_message(n, k, 1, 1), 1 + k) for k in range(8)]
        link.put(*pings, now=n * 0.001)
    assert MIN_LANE_BYTES - 50 <= egress.lanes.size <= MIN_LANE_BYTES
    assert link.egress.totals == {EgressDrop.OVERFLOW: 500 - kept + 480 - egress.count}


@pytest.mark.long
def test_memory_is_bounded_under_a_flood_of_replaceable_frames() -> None:
    """What was replaced leaves nothing behind, and flows that are empty are forgotten."""
    link = Link(SLOW)
    link.transmit(4000, 0.0)
    link.put(*(attitude(n) for n in range(5000)), now=0.0)
    lanes = link.egress.lanes
    assert len(lanes.queues[Lane.STATES].arrivals) <= 100
    for start in range(0, 3 * MAX_FLOWS, 1024):
        names = (f"{n}".encode() for n in range(start, start + 1024))
        link.put(*(frame(mavlink.MAVLink_named_value_float_message(1, name, 1.5)) for name in names), now=0.0)
    assert len(lanes._flows) <= MAX_FLOWS
    assert len(lanes.queues[Lane.STATES].line) <= 2 * lanes.count + 65


@settings(max_examples=30)
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
    assert len(link.offered) == len(link.sent) + egress.totals.total() + egress.count
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
    assert egress.count == 0
    assert egress.next_deadline() == inf


def test_demand_says_how_much_is_sent_and_dropped() -> None:
    """As a share of the budget: many times the budget under a flood, none once all is quiet."""
    flooded = Link(SLOW)
    play(flooded, every(0.002, attitude, 10.0), until=10.0)
    assert flooded.egress.demand(10.0) > 10
    fair = Link(SLOW)
    play(fair, every(0.5, attitude, 20.0), until=20.0)
    assert fair.egress.demand(20.0) == pytest.approx(2 * (40 + 51) / 500, rel=0.35)
    assert fair.egress.demand(60.0) < 0.001
