"""What waits for a slow link: coalescing, the budget on the wire, who goes first, and what is dropped."""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from math import inf
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink import dialect_generate
from uavlinkd.mavlink.egress import kinds as egress_kinds
from uavlinkd.mavlink.dialect import ids_by_name, name_of
from uavlinkd.mavlink.egress.budgeted import BURST_S, MAX_FLOWS, MIN_LANE_BYTES, Egress, EgressSettings, EnvelopeShape
from uavlinkd.mavlink.egress.kinds import Lane, flow_key, kind_of
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import Frame, Header, SplitCounters, split_datagram

SHAPE = EnvelopeShape(payload_limit=1200, seal_bytes=23, carrier_bytes=28)
SLOW = EgressSettings(budget_bits_s=4000)
ID = ids_by_name()


def frame(message: Any, system: int = 1, component: int = 1) -> Frame:
    """The message as this daemon would read it from a local program."""
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    (found,) = split_datagram(message.pack(sender), SplitCounters())
    return found


def attitude(number: int, system: int = 1) -> Frame:
    return frame(mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1), system)


def heartbeat(number: int, system: int = 1, component: int = 1) -> Frame:
    return frame(mavlink.MAVLink_heartbeat_message(2, 3, 81, number, 4, 3), system, component)


def command(number: int, system: int = 255) -> Frame:
    return frame(mavlink.MAVLink_command_long_message(1, 1, 400, 0, number, 1, 1, 1, 1, 1, 1), system)


def parameter(number: int) -> Frame:
    return frame(mavlink.MAVLink_param_value_message(b"SERVO_FUNCTION", float(number), 9, 999, number))


def battery(number: int, which: int) -> Frame:
    return frame(mavlink.MAVLink_battery_status_message(which, 1, 1, 2500, [4000] * 10, 120, number, 9, 77))


class Link:
    """One egress, and the wire behind it: each envelope is sent and accounted for at once. Time is virtual."""

    def __init__(self, options: EgressSettings, shape: EnvelopeShape = SHAPE) -> None:
        self.egress = Egress(options, 0.0, shape)
        self.shape = shape
        self.sent: list[tuple[float, bytes]] = []
        self.envelopes: list[tuple[float, list[bytes]]] = []
        self.wire: list[tuple[float, int]] = []
        self.offered: dict[bytes, float] = {}

    def put(self, *frames: Frame, now: float) -> None:
        for each in frames:
            assert each.raw not in self.offered, "frames of a test are told apart by their bytes"
            self.offered[each.raw] = now
        self.egress.put(frames, now)
        self.flush(now)

    def flush(self, now: float) -> None:
        while batch := self.egress.take(now):
            self.envelopes.append((now, batch))
            self.sent += [(now, raw) for raw in batch]
            self.transmit(self.shape.seal_bytes + sum(map(len, batch)), now)

    def transmit(self, datagram_bytes: int, now: float) -> None:
        self.egress.spend(datagram_bytes, now)
        self.wire.append((now, datagram_bytes + self.shape.carrier_bytes))

    def run(self, until: float) -> None:
        """Let time pass: the egress is called at its deadlines and never else."""
        for _ in range(1_000_000):
            deadline = self.egress.next_deadline()
            if deadline > until:
                return
            self.flush(deadline)
        raise AssertionError("deadlines without end")

    def names(self) -> list[str]:
        return [name_of(id_of(raw)) for _, raw in self.sent]


def id_of(raw: bytes) -> int:
    return int.from_bytes(raw[7:10], "little")


def flow_of(raw: bytes) -> egress_kinds.FlowKey:
    (found,) = split_datagram(raw, SplitCounters())
    return flow_key(found, kind_of(found))


def play(link: Link, offers: Iterable[tuple[float, Frame | Callable[[], None]]], until: float) -> None:
    """Offer frames at their times; a function stands for something else that happens then."""
    for now, what in sorted(offers, key=lambda offer: offer[0]):
        link.run(now)
        if isinstance(what, Frame):
            link.put(what, now=now)
        else:
            what()
    link.run(until)


def every(period: float, make: Callable[[int], Frame], until: float, start: float = 0.0) -> list[tuple[float, Frame]]:
    return [(start + n * period, make(n)) for n in range(int((until - start) / period))]


# Without a budget: coalescing.


def test_frames_share_an_envelope_after_the_delay() -> None:
    """Frames wait from the first of them for the delay, not longer, and go together in their order."""
    link = Link(EgressSettings(coalesce_s=0.05))
    frames = [attitude(1), parameter(1), battery(1, 0), attitude(2)]
    for n, each in enumerate(frames):
        link.put(each, now=n * 0.01)
    assert not link.sent
    assert link.egress.next_deadline() == 0.05
    assert link.egress.take(0.0499) == []
    link.flush(0.05)
    assert link.envelopes == [(0.05, [each.raw for each in frames])]
    assert link.egress.next_deadline() == inf


def test_full_envelope_does_not_wait() -> None:
    """As soon as an envelope's worth is there it goes, and what does not fit goes on waiting."""
    link = Link(EgressSettings(coalesce_s=0.5), EnvelopeShape(payload_limit=300))
    frames = [attitude(n) for n in range(10)]  # 40 bytes each: seven fit, the eighth makes it full
    for each in frames:
        link.put(each, now=0.1)
    assert link.envelopes == [(0.1, [each.raw for each in frames[:7]])]
    assert link.egress.next_deadline() == pytest.approx(0.6)
    link.run(1.0)
    assert [raw for _, raw in link.sent] == [each.raw for each in frames]


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
    play(link, [(n * 0.002, each) for n, each in enumerate(frames)], until=2.0)
    assert [raw for _, raw in link.sent] == [each.raw for each in frames]
    assert not link.egress.totals
    assert all(now - link.offered[raw] <= 0.1 + 1e-9 for now, raw in link.sent)


# The budget.


def test_idle_link_sends_at_once_and_in_order() -> None:
    """While the bucket covers what there is, nothing waits and nothing is reordered or thinned."""
    link = Link(SLOW)
    frames = [attitude(1), battery(1, 0), heartbeat(1), attitude(2)]
    link.egress.put(frames, 0.0)
    assert link.egress.take(0.0) == [each.raw for each in frames]


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


# What matters first.

OFFER_S = 60.0


def flight() -> list[tuple[float, Frame]]:
    """300 frames a second as they come: one vehicle with gimbal and companion, and a ground station's dialogue."""
    m = mavlink

    def at(rate: float, make: Callable[[int], Frame], start: float) -> list[tuple[float, Frame]]:
        return every(1 / rate, make, OFFER_S, start)

    def state(kind: Any, *values: Any) -> Callable[[int], Frame]:
        return lambda n: frame(kind(n, *values))

    return [
        *at(1, heartbeat, 0.013),
        *at(1, lambda n: heartbeat(n, 1, 154), 0.301),
        *at(1, lambda n: heartbeat(n, 1, 191), 0.655),
        *at(1, command, 0.417),
        *at(1, lambda n: frame(m.MAVLink_command_ack_message(400, 0, 1, n, 255, 190)), 0.533),
        *at(1, lambda n: frame(m.MAVLink_set_mode_message(1, 1, n), 255), 0.892),
        *at(50, attitude, 0.001),
        *at(50, state(m.MAVLink_attitude_quaternion_message, 1, 0.5, 0.5, 0.5, 0.1, 0.1, 0.1), 0.002),
        *at(50, state(m.MAVLink_highres_imu_message, *([1.5] * 13), 7), 0.003),
        *at(35, state(m.MAVLink_global_position_int_message, 473977418, 85455940, 9, 9, 9, 9, 9, 9), 0.004),
        *at(30, state(m.MAVLink_local_position_ned_message, *([2.5] * 6)), 0.005),
        *at(20, state(m.MAVLink_servo_output_raw_message, 0, *([1500] * 8)), 0.006),
        *at(10, state(m.MAVLink_rc_channels_message, 18, *([1500] * 18), 99), 0.007),
        *at(10, lambda n: frame(m.MAVLink_vfr_hud_message(9.5, 8.5, 120, 50, float(n), 0.5)), 0.008),
        *at(5, state(m.MAVLink_gps_raw_int_message, 3, 473977418, 85455940, 9, 9, 9, 9, 9, 9), 0.009),
        *at(5, state(m.MAVLink_vibration_message, 0.1, 0.2, 0.3, 1, 2, 3), 0.010),
        *at(1, lambda n: frame(m.MAVLink_sys_status_message(1, 2, 3, 500, n, 20, 80, 0, 0, 0, 0, 0, 0)), 0.011),
        *at(1, state(m.MAVLink_system_time_message, 77), 0.012),
        *at(0.5, lambda n: battery(n, 0), 0.014),
        *at(0.5, lambda n: battery(n, 1), 0.015),
        *at(1, lambda n: frame(m.MAVLink_mission_current_message(n)), 0.016),
        *at(0.5, lambda n: frame(m.MAVLink_statustext_message(6, f"text {n}".encode())), 0.017),
        *at(25, parameter, 0.018),
    ]


URGENT = {"HEARTBEAT", "COMMAND_LONG", "COMMAND_ACK", "SET_MODE"}


@pytest.fixture(scope="module")
def slow_flight() -> Link:
    """A minute of the flight over 4 kbit/s, with an echo each second and new keys in the middle."""
    link = Link(SLOW)
    offers: list[tuple[float, Frame | Callable[[], None]]] = [*flight()]
    assert len(offers) == pytest.approx(300 * OFFER_S, rel=0.01)
    for second in range(int(OFFER_S)):
        offers.append((second + 0.5, lambda now=second + 0.5: link.transmit(34, now)))  # type: ignore[misc]
    offers.append((30.0, lambda: link.transmit(190, 30.0)))
    play(link, offers, until=OFFER_S)
    return link


def test_budget_holds_over_any_time(slow_flight: Link) -> None:
    """Between any two envelopes no more goes over the wire than the budget, the bucket and the core's own excess."""
    burst = 51 + 280
    total = sum(size for _, size in slow_flight.wire)
    assert total <= 500 * OFFER_S + burst
    assert total >= 0.97 * 500 * OFFER_S, "and the budget is used"
    passed = [(now, size) for now, size in slow_flight.wire]
    level, before = 0.0, 0.0
    worst = 0.0
    for now, size in passed:  # a leaky bucket beside the one that is tested
        level = max(0.0, level - (now - before) * 500) + size
        before = now
        worst = max(worst, level)
    assert worst <= burst + 34 + 28 + 190 + 28


def test_what_is_urgent_leaves_within_a_second(slow_flight: Link) -> None:
    """Of 300 frames a second over 4 kbit/s every heartbeat, command and acknowledgement leaves within a second."""
    sent_at = {raw: now for now, raw in slow_flight.sent}
    waits: dict[str, list[float]] = {}
    for raw, offered_at in slow_flight.offered.items():
        name = name_of(id_of(raw))
        if name in URGENT and offered_at < OFFER_S - 1:
            waits.setdefault(name, []).append(sent_at.get(raw, inf) - offered_at)
    assert waits.keys() == URGENT
    assert {name: len(each) for name, each in waits.items()}["HEARTBEAT"] == 3 * (OFFER_S - 1)
    assert max(max(each) for each in waits.values()) <= 1.0


def test_all_is_sent_or_counted(slow_flight: Link) -> None:
    """Each frame offered was sent once, or is counted under its reason, or still waits; nothing urgent is left."""
    egress = slow_flight.egress
    sent = {raw for _, raw in slow_flight.sent}
    assert len(sent) == len(slow_flight.sent)
    assert sent <= slow_flight.offered.keys()
    unsent = Counter(id_of(raw) for raw in slow_flight.offered if raw not in sent)
    assert unsent.total() == egress.totals.total() + egress.queued_frames
    assert unsent[ID["ATTITUDE"]] > 40 * OFFER_S
    assert not any(name_of(msgid) in URGENT for msgid in unsent)
    assert egress.totals.keys() == {EgressDrop.THINNED, EgressDrop.STALE}
    kinds = {msgid: egress_kinds.KINDS.get(msgid, egress_kinds.EVENT) for msgid in unsent}
    states = sum(amount for msgid, amount in unsent.items() if kinds[msgid].is_state)
    assert 0.99 * states < egress.totals[EgressDrop.THINNED] <= states


def test_nothing_leaves_late(slow_flight: Link) -> None:
    """No frame is older than max_age_s when it leaves."""
    assert max(now - slow_flight.offered[raw] for now, raw in slow_flight.sent) <= 1.0


def test_all_states_are_thinned_alike(slow_flight: Link) -> None:
    """No state starves: every message that was offered often enough goes as often as any other, give or take."""
    gaps: dict[int, float] = {}
    for msgid in {id_of(raw) for raw in slow_flight.offered} - {ID[name] for name in URGENT}:
        times = [0.0, *(now for now, raw in slow_flight.sent if id_of(raw) == msgid), OFFER_S]
        gaps[msgid] = max(late - early for early, late in pairwise(times))
    assert max(gaps.values()) <= 10.0, {name_of(msgid): gap for msgid, gap in gaps.items()}
    often = ["ATTITUDE", "ATTITUDE_QUATERNION", "HIGHRES_IMU", "GLOBAL_POSITION_INT", "SERVO_OUTPUT_RAW"]
    amounts = [slow_flight.names().count(name) for name in often]
    assert max(amounts) - min(amounts) <= 3, amounts


def test_order_within_a_flow_is_kept(slow_flight: Link) -> None:
    """What one sender said with one message about one thing leaves in the order in which it was said."""
    number = {raw: n for n, raw in enumerate(slow_flight.offered)}
    last: dict[egress_kinds.FlowKey, int] = {}
    for _, raw in slow_flight.sent:
        flow = flow_of(raw)
        assert number[raw] > last.get(flow, -1)
        last[flow] = number[raw]


def test_demand_says_how_much_too_much_there_is(slow_flight: Link) -> None:
    """Sent and dropped bytes as a share of the budget: many times the budget here, none once all is quiet."""
    assert slow_flight.egress.demand(OFFER_S) > 10
    fair = Link(SLOW)
    play(fair, every(0.5, attitude, 20.0), until=20.0)
    assert fair.egress.demand(20.0) == pytest.approx(2 * (40 + 51) / 500, rel=0.35)
    assert fair.egress.demand(60.0) < 0.001


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
    assert [raw for _, raw in link.sent] == [each.raw for each in frames]


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
    assert [raw for _, raw in link.sent] == [each.raw for each in frames]


def test_flood_of_commands_leaves_room_for_heartbeats() -> None:
    """A program that floods commands delays another's heartbeat by a turn, no more."""
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
        0.005,
        lambda n: frame(mavlink.MAVLink_named_value_float_message(n, f"n{n}".encode(), 1.5), 9),
        30.0,
    )
    play(link, offers, until=30.0)
    times = [now for now, raw in link.sent if id_of(raw) == ID["ATTITUDE"]]
    assert max(late - early for early, late in pairwise([*times, 30.0])) <= 4.0


# Bounds.


def test_frame_at_the_age_limit_goes_and_a_later_one_does_not() -> None:
    """A frame leaves at max_age_s exactly, and is dropped as stale just after."""
    for taken_at, sent in ((1.0, 1), (1.001, 0)):
        egress = Egress(EgressSettings(coalesce_s=0.5), 0.0)
        egress.put([attitude(1)], 0.0)
        assert len(egress.take(taken_at)) == sent
        assert egress.totals == ({} if sent else {EgressDrop.STALE: 1})


def test_queue_is_bounded_and_drops_the_oldest() -> None:
    """However much one flow offers it holds half of its lane, in the newest frames; other lanes are untouched."""
    egress = Egress(SLOW, 0.0)
    egress.spend(4000, 0.0)
    frames = [parameter(n) for n in range(500)]
    egress.put(frames, 0.0)
    assert MIN_LANE_BYTES / 2 - 50 <= egress.queued_bytes <= MIN_LANE_BYTES / 2
    kept = egress.queued_frames
    assert egress.totals == {EgressDrop.OVERFLOW: 500 - kept}
    egress.put([heartbeat(1)], 0.0)
    assert egress.queued_frames == kept + 1


def test_overflow_drops_the_oldest_first() -> None:
    """What is left of too much is the newest of it, in order."""
    link = Link(EgressSettings(coalesce_s=0.1))
    frames = [parameter(n) for n in range(2000)]
    link.egress.put(frames, 0.0)
    kept = link.egress.queued_frames
    assert 0 < kept < 2000
    link.flush(0.1)
    assert [raw for _, raw in link.sent] == [each.raw for each in frames[-kept:]]


def test_lane_is_bounded_whoever_fills_it() -> None:
    """Many senders together fill a lane to its bound; then its oldest frame goes for each new one."""
    egress = Egress(SLOW, 0.0)
    egress.spend(4000, 0.0)
    for n in range(60):
        egress.put([frame(mavlink.MAVLink_ping_message(n, k, 1, 1), 1 + k) for k in range(8)], n * 0.001)
    assert MIN_LANE_BYTES - 50 <= egress.queued_bytes <= MIN_LANE_BYTES
    assert egress.totals == {EgressDrop.OVERFLOW: 480 - egress.queued_frames}


def test_memory_is_bounded_under_a_flood_of_replaceable_frames() -> None:
    """What was replaced leaves nothing behind, and flows that are empty are forgotten."""
    egress = Egress(SLOW, 0.0)
    egress.spend(4000, 0.0)
    egress.put([attitude(n) for n in range(5000)], 0.0)
    assert len(egress._lanes.queues[Lane.STATES].arrivals) <= 100
    for start in range(0, 3 * MAX_FLOWS, 1024):
        names = (f"{n}".encode() for n in range(start, start + 1024))
        egress.put([frame(mavlink.MAVLink_named_value_float_message(1, name, 1.5)) for name in names], 0.0)
    assert len(egress._lanes._flows) <= MAX_FLOWS
    assert len(egress._lanes.queues[Lane.STATES].line) <= 2 * egress.queued_frames + 65


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


MAKERS: Sequence[Callable[[int], Frame]] = (
    attitude,
    heartbeat,
    command,
    parameter,
    lambda n: attitude(n, 2),
    lambda n: battery(n, n % 3),
    lambda n: frame(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [1 + n % 255] * 251), 1 + n // 255),
)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    budget=st.sampled_from([0, 1000, 4000, 64_000, 1_000_000]),
    coalesce=st.sampled_from([0.0, 0.02, 0.3]),
    limit=st.sampled_from([281, 400, 1200]),
)
def test_whatever_happens_the_rules_hold(seed: int, budget: int, coalesce: float, limit: int) -> None:
    """Sent at most once, never late, whole envelopes only, in order, all accounted for, and within the budget."""
    chance = random.Random(seed)
    shape = EnvelopeShape(payload_limit=limit)
    link = Link(EgressSettings(budget_bits_s=budget, coalesce_s=coalesce), shape)
    egress = link.egress
    now = 0.0
    core = 0
    for n in range(120):
        now += chance.choice((0.0, 0.001, 0.02, 0.3, 1.2))
        if chance.random() < 0.7:
            link.run(now)
        link.put(*(make(n) for make in MAKERS if chance.random() < 0.4), now=now)
        if chance.random() < 0.05:
            core += 100 + shape.carrier_bytes
            link.transmit(100, now)
    link.run(now + 5)
    assert len(link.offered) == len(link.sent) + egress.totals.total() + egress.queued_frames
    assert len({raw for _, raw in link.sent}) == len(link.sent)
    assert all(raw in link.offered and at - link.offered[raw] <= 1.0 for at, raw in link.sent)
    assert all(sum(map(len, batch)) <= limit for _, batch in link.envelopes)
    number = {raw: n for n, raw in enumerate(link.offered)}
    last: dict[egress_kinds.FlowKey, int] = {}
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


# Kinds.


def layouts() -> dict[str, tuple[str | None, list[tuple[str, int, int]]]]:
    """Of each message the field that its definition says tells instances apart, and each field's offset and size."""
    width = {"8": 1, "16": 2, "32": 4, "64": 8, "float": 4, "double": 8, "char": 1}
    found: dict[str, tuple[str | None, list[tuple[str, int, int]]]] = {}
    for kind in mavlink.mavlink_map.values():
        types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
        offset, fields = 0, []
        for field, array in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True):
            bits = types[field].removesuffix("_t").removeprefix("u").removeprefix("int")
            fields.append((field, offset, width[bits] * max(1, array)))
            offset += fields[-1][2]
        found[kind.msgname] = (getattr(kind, "instance_field", None), fields)
    for message in dialect_generate.upstream():
        instance = next((field.name for field in message.fields if field.instance), None)
        fields = [(field.name, field.wire_offset, field.wire_length) for field in message.fields]
        found[message.name] = (instance, fields)
    return found


def test_instance_fields_stand_where_pymavlink_packs_them() -> None:
    """The bytes that tell instances apart are the fields that do, whole, and no other."""
    known = layouts()
    for name, (at, length) in egress_kinds.INSTANCES.items():
        instance, fields = known[name]
        covered = [(field, size) for field, offset, size in fields if at <= offset < at + length]
        assert sum(size for _, size in covered) == length, f"{name}: half of {covered}"
        assert instance is None or instance in dict(covered), name


def test_every_state_whose_definition_numbers_it_has_its_instances_told_apart() -> None:
    """A message whose definition names an instance field is no state without that field in its flow."""
    for name, (instance, _) in layouts().items():
        known = egress_kinds.KINDS.get(ID[name])
        if instance and known is not None and known.is_state:
            assert known.instance_bytes, name


def test_cut_instance_is_the_same_instance() -> None:
    """A field that MAVLink 2 cut off with the payload's zeros counts as zero, and the checksum is not read for it."""
    keys = set()
    for n in range(5):
        told = frame(mavlink.MAVLink_servo_output_raw_message(n, 0, *([1500 + n] * 8)))
        cut = frame(mavlink.MAVLink_rc_channels_raw_message(n, 0, *([1500 + n] * 8), 0))
        assert cut.raw[1] < 21, "port is cut"
        keys |= {flow_key(told, kind_of(told)), flow_key(cut, kind_of(cut))}
    assert len(keys) == 2


@pytest.mark.parametrize(
    ("name", "lane", "is_state"),
    [
        ("HEARTBEAT", Lane.URGENT, True),
        ("MANUAL_CONTROL", Lane.URGENT, True),
        ("COMMAND_LONG", Lane.URGENT, False),
        ("COMMAND_ACK", Lane.URGENT, False),
        ("ATTITUDE", Lane.STATES, True),
        ("SET_POSITION_TARGET_LOCAL_NED", Lane.STATES, True),
        ("PARAM_VALUE", Lane.EVENTS, False),
        ("MISSION_ITEM_INT", Lane.EVENTS, False),
        ("FILE_TRANSFER_PROTOCOL", Lane.EVENTS, False),
        ("STATUSTEXT", Lane.EVENTS, False),
        ("GPS_RTCM_DATA", Lane.EVENTS, False),
        ("TIMESYNC", Lane.EVENTS, False),
        ("MISSION_ITEM_REACHED", Lane.EVENTS, False),
        ("EVENT", Lane.EVENTS, False),
        ("CURRENT_EVENT_SEQUENCE", Lane.STATES, True),
        ("COMPONENT_METADATA", Lane.EVENTS, False),
        ("ESC_STATUS", Lane.STATES, True),
        ("COMMAND_CANCEL", Lane.URGENT, False),
    ],
)
def test_messages_wait_as_documented(name: str, lane: Lane, is_state: bool) -> None:
    """What replaces nothing is never thinned, and what matters is urgent."""
    found = egress_kinds.KINDS.get(ID[name], egress_kinds.EVENT)
    assert (found.lane, found.is_state) == (lane, is_state)
