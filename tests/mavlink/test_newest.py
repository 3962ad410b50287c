"""States of a peer with several paths never go back, and no event is dropped."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import NamedTuple

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.samples import attitude, battery, command, frame, heartbeat, parameter
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.newest import MAX_FLOWS, NewestStates

RATE_HZ = 25
SECONDS = 120
MAX_PER_FLIGHT = RATE_HZ * SECONDS


class PlannedPath(NamedTuple):
    """A one-way path: delay in seconds, and the share of datagrams that it loses."""

    delay_s: float
    loss: float


FAST_AND_LOSSY, SLOW = PlannedPath(0.05, 0.3), PlannedPath(0.4, 0.0)


def manual_control(number: int) -> Frame:
    """A joystick's position: the number is in it."""
    return frame(mavlink.MAVLink_manual_control_message(1, number % 1000, number // 1000, 500, 0, 0), 255)


def number_of(control: Frame) -> int:
    """What :func:`manual_control` put into the frame."""
    payload = control.raw[10 : 10 + control.raw[1]].ljust(11, b"\0")
    return int.from_bytes(payload[:2], "little") + 1000 * int.from_bytes(payload[2:4], "little")


def arrivals(paths: Sequence[PlannedPath], seed: int) -> list[int]:
    """The orders of envelopes at 25 Hz as their first copies arrive: each is sent along every path."""
    rng = random.Random(seed)
    arriving: list[tuple[float, int]] = []
    for number in range(MAX_PER_FLIGHT):
        delays = [path.delay_s for path in paths if rng.random() >= path.loss]
        if delays:
            arriving.append((number / RATE_HZ + min(delays), number))
    return [number for _, number in sorted(arriving)]


def steps_back(numbers: Sequence[int]) -> int:
    """How many are lower than one before them."""
    highest, count = -1, 0
    for number in numbers:
        count += number < highest
        highest = max(highest, number)
    return count


def test_joystick_over_a_lossy_fast_path_and_a_slow_one_never_goes_back() -> None:
    """Without the rule 29 % of the delivered frames would be older than one before them."""
    order = arrivals([FAST_AND_LOSSY, SLOW], seed=19)
    assert 0.26 < steps_back(order) / len(order) < 0.32
    newest = NewestStates()
    delivered = [number_of(got) for number in order for got in newest.pick([manual_control(number)], number + 1)]
    assert steps_back(delivered) == 0
    assert len(delivered) == len(order) - steps_back(order), "only what would go back is dropped"


def test_commands_over_the_same_paths_are_delivered_as_they_arrive() -> None:
    """An event is delivered even if a later one of its flow came first."""
    order = arrivals([FAST_AND_LOSSY, SLOW], seed=19)
    newest = NewestStates()
    sent = {number: command(number) for number in order}
    delivered = [got for number in order for got in newest.pick([sent[number]], number + 1)]
    assert delivered == [sent[number] for number in order]


def test_copies_of_one_flow_in_one_envelope_are_all_delivered() -> None:
    """They have one order, and are in the order of their sender."""
    together = [attitude(1), attitude(2), command(1), attitude(3)]
    assert NewestStates().pick(together, 7) is together


def test_other_flows_of_an_older_envelope_are_delivered() -> None:
    """The newer envelope had another battery, and neither the other vehicle nor the parameter."""
    newest = NewestStates()
    newest.pick([attitude(9), battery(9, 0)], 10)
    late = [attitude(1), attitude(1, 2), battery(1, 0), battery(1, 1), parameter(1), heartbeat(1)]
    assert newest.pick(late, 9) == [attitude(1, 2), battery(1, 1), parameter(1), heartbeat(1)]


ENVELOPES = st.lists(
    st.tuples(
        st.integers(1, 30),
        st.lists(
            st.one_of(
                st.builds(attitude, st.integers(0, 3), st.integers(1, 2)),
                st.builds(battery, st.integers(0, 3), st.integers(0, 1)),
                st.builds(command, st.integers(0, 3)),
            ),
            max_size=4,
        ),
    ),
    max_size=20,
)


@given(ENVELOPES)
def test_picks_what_the_rule_says(envelopes: list[tuple[int, list[Frame]]]) -> None:
    """The rule, written down once more without any speed: for each flow the last delivered order."""
    newest = NewestStates()
    last: dict[FlowKey, int] = {}
    for order, frames in envelopes:
        expected = [one for one in frames if not one.header.kind.is_state or order >= last.get(flow_key(one), 0)]
        last |= {flow_key(one): order for one in expected}
        assert newest.pick(frames, order) == expected


def test_invented_flows_use_bounded_memory_and_a_flow_in_use_is_kept() -> None:
    """A member can invent components and instances. The rule still holds for the flow that goes on."""
    newest = NewestStates()
    for number in range(1, 4 * MAX_FLOWS):
        newest.pick([attitude(number), heartbeat(0, 1 + number % 250, 1 + number // 250)], 2 * number)
        assert len(newest) <= 2 * MAX_FLOWS
        assert newest.pick([attitude(number - 1)], 2 * number - 1) == []
