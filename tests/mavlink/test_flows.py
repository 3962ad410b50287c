"""Flows: instances of a state are separated by the right bytes, commands keep their order, states never go back."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import attitude, battery, command, frame, heartbeat
from uavlinkd.mavlink.flows import MAX_FLOWS, FlowKey, NewestStates, flow_key
from uavlinkd.mavlink.frames import Frame


def test_cut_instance_is_the_same_instance() -> None:
    """A field that MAVLink 2 cut off with the payload's zeros counts as zero, and the checksum is not read for it."""
    keys = set()
    for n in range(5):
        whole = frame(mavlink.MAVLink_servo_output_raw_message(n, 0, *([1500 + n] * 8)))
        cut = frame(mavlink.MAVLink_rc_channels_raw_message(n, 0, *([1500 + n] * 8), 0))
        assert cut.raw[1] < 21, "port is cut"
        keys |= {flow_key(whole), flow_key(cut)}
    assert len(keys) == 2


def test_commands_of_a_sender_are_one_flow_and_each_other_event_has_its_own() -> None:
    """Arming comes before take-off, whatever message carries each of them."""
    arm = frame(mavlink.MAVLink_command_long_message(1, 1, 400, 0, *[1] * 7), 255)
    take_off = frame(mavlink.MAVLink_command_int_message(2, 1, 3, 22, 0, 0, *[1] * 7), 255)
    first = frame(mavlink.MAVLink_param_request_read_message(1, 1, b"A", -1), 255)
    second = frame(mavlink.MAVLink_param_request_read_message(2, 1, b"B", -1), 255)
    assert flow_key(arm) == flow_key(take_off) != flow_key(first) == flow_key(second)
    assert flow_key(frame(mavlink.MAVLink_command_long_message(1, 1, 400, 0, *[1] * 7), 254)) != flow_key(arm)


def test_states_for_different_targets_are_different_flows() -> None:
    """A ground station may steer two vehicles with one joystick each."""
    keys = [flow_key(frame(mavlink.MAVLink_manual_control_message(n % 2, 1, 2, 3, 4, 5), 255)) for n in range(4)]
    assert keys[0] == keys[2] != keys[1] == keys[3]


# States of a peer with several paths never go back, and no event is dropped.


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
        assert len(newest._orders) <= MAX_FLOWS
        assert newest.pick([attitude(number - 1)], 2 * number - 1) == []
