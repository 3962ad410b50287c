"""A minute of a recorded kind of flight over 4 kbit/s: within the budget, urgent frames first, nothing late."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from math import inf
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.links import SLOW, Link, every, id_of, play
from tests.samples import ID, attitude, battery, command, frame, heartbeat, parameter
from uavlinkd.mavlink.classes import KINDS
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import Frame

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


def test_budget_is_used_and_not_exceeded(slow_flight: Link) -> None:
    """As much goes over the wire as the budget and the bucket allow; the property of the egress has any interval."""
    total = sum(size for _, size in slow_flight.wire)
    assert 0.97 * 500 * OFFER_S <= total <= 500 * OFFER_S + 51 + 280


def test_what_is_urgent_leaves_within_a_second(slow_flight: Link) -> None:
    """Of 300 frames a second over 4 kbit/s every heartbeat, command and acknowledgement leaves within a second."""
    sent_at = {raw: now for now, raw in slow_flight.sent}
    waits: dict[str, list[float]] = {}
    for raw, offered_at in slow_flight.offered.items():
        name = name_of(id_of(raw))
        if name in URGENT and offered_at < OFFER_S - 1:
            waits.setdefault(name, []).append(sent_at.get(raw, inf) - offered_at)
    assert waits.keys() == URGENT
    assert {name: len(times) for name, times in waits.items()}["HEARTBEAT"] == 3 * (OFFER_S - 1)
    assert max(map(max, waits.values())) <= 1.0


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
    states = sum(count for msgid, count in unsent.items() if KINDS[msgid].is_state)
    assert 0.99 * states < egress.totals[EgressDrop.THINNED] <= states


def test_all_states_are_thinned_alike(slow_flight: Link) -> None:
    """No state starves: every message that was offered often enough goes as often as any other, give or take."""
    gaps: dict[int, float] = {}
    for msgid in {id_of(raw) for raw in slow_flight.offered} - {ID[name] for name in URGENT}:
        times = [0.0, *(now for now, raw in slow_flight.sent if id_of(raw) == msgid), OFFER_S]
        gaps[msgid] = max(late - early for early, late in pairwise(times))
    assert max(gaps.values()) <= 10.0, {name_of(msgid): gap for msgid, gap in gaps.items()}
    often = ["ATTITUDE", "ATTITUDE_QUATERNION", "HIGHRES_IMU", "GLOBAL_POSITION_INT", "SERVO_OUTPUT_RAW"]
    counts = [slow_flight.names().count(name) for name in often]
    assert max(counts) - min(counts) <= 3, counts


def test_demand_says_how_much_too_much_there_is(slow_flight: Link) -> None:
    """Sent and dropped bytes as a share of the budget: many times the budget here, none once all is quiet."""
    assert slow_flight.egress.demand(OFFER_S) > 10
    fair = Link(SLOW)
    play(fair, every(0.5, attitude, 20.0), until=20.0)
    assert fair.egress.demand(20.0) == pytest.approx(2 * (40 + 51) / 500, rel=0.35)
    assert fair.egress.demand(60.0) < 0.001
