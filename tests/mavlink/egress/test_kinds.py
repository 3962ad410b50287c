"""Each message waits as the documentation says, and its instances are separated by the right bytes."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.samples import ID, frame
from uavlinkd.mavlink import dialect_generate
from uavlinkd.mavlink.egress import kinds as egress_kinds
from uavlinkd.mavlink.egress.kinds import Lane, flow_key, kind_of


def layouts() -> dict[str, tuple[str | None, list[tuple[str, int, int]]]]:
    """Of each message the field that its definition says tells instances apart, and each field's offset and size."""
    width = {"8": 1, "16": 2, "32": 4, "64": 8, "float": 4, "double": 8, "char": 1}
    fields_of: dict[str, tuple[str | None, list[tuple[str, int, int]]]] = {}
    for kind in mavlink.mavlink_map.values():
        types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
        offset, fields = 0, []
        for field, array in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True):
            bits = types[field].removesuffix("_t").removeprefix("u").removeprefix("int")
            fields.append((field, offset, width[bits] * max(1, array)))
            offset += fields[-1][2]
        fields_of[kind.msgname] = (getattr(kind, "instance_field", None), fields)
    for message in dialect_generate.upstream():
        instance = next((field.name for field in message.fields if field.instance), None)
        fields = [(field.name, field.wire_offset, field.wire_length) for field in message.fields]
        fields_of[message.name] = (instance, fields)
    return fields_of


def test_instance_fields_stand_where_pymavlink_packs_them() -> None:
    """The bytes that tell instances apart are the fields that do, whole, and no other."""
    known = layouts()
    for name, (at, length) in egress_kinds.INSTANCES.items():
        instance, fields = known[name]
        covered = [(field, size) for field, offset, size in fields if at <= offset < at + length]
        assert sum(size for _, size in covered) == length, f"{name}: half of {covered}"
        assert instance is None or instance in dict(covered), name


def test_every_state_whose_definition_numbers_it_has_separate_instances() -> None:
    """A message whose definition names an instance field is a state only with that field in its flow."""
    for name, (instance, _) in layouts().items():
        known = egress_kinds.KINDS.get(ID[name])
        if instance and known is not None and known.is_state:
            assert known.instance_bytes, name


def test_cut_instance_is_the_same_instance() -> None:
    """A field that MAVLink 2 cut off with the payload's zeros counts as zero, and the checksum is not read for it."""
    keys = set()
    for n in range(5):
        whole = frame(mavlink.MAVLink_servo_output_raw_message(n, 0, *([1500 + n] * 8)))
        cut = frame(mavlink.MAVLink_rc_channels_raw_message(n, 0, *([1500 + n] * 8), 0))
        assert cut.raw[1] < 21, "port is cut"
        keys |= {flow_key(whole, kind_of(whole)), flow_key(cut, kind_of(cut))}
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
    kind = egress_kinds.KINDS.get(ID[name], egress_kinds.EVENT)
    assert (kind.lane, kind.is_state) == (lane, is_state)
