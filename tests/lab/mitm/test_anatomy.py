"""What a datagram shows to someone without keys, and the one thing that can be computed about it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.mitm.samples import ATTITUDE, HEARTBEAT, converse
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.suites import SUITES, Suite
from uavlinkd.lab.mitm import anatomy
from uavlinkd.lab.mitm.anatomy import DatagramKind, envelope_of, kind_of, message_ids, parts_of, with_mac1
from uavlinkd.lab.mitm.attacks.forgery import COMMAND_FRAMES

CONVERSATION = converse()


@pytest.mark.parametrize(
    ("datagram", "kind"),
    [
        (b"", DatagramKind.EMPTY),
        (b"\x01", DatagramKind.INITIATION),
        (b"\x02x", DatagramKind.RESPONSE),
        (b"\x03", DatagramKind.COOKIE),
        (b"\x40", DatagramKind.ENVELOPE),
        (b"\x41", DatagramKind.ENVELOPE),
        (b"\xfd", DatagramKind.MAVLINK),
        (b"\xfe", DatagramKind.MAVLINK),
        (b"\x00", DatagramKind.OTHER),
        (b"\x42", DatagramKind.OTHER),
    ],
)
def test_first_byte_determines_the_kind(datagram: bytes, kind: DatagramKind) -> None:
    """The first byte only, for any following bytes."""
    assert kind_of(datagram) is kind


@pytest.mark.parametrize("suite", SUITES.values(), ids=lambda suite: suite.name)
def test_handshake_messages_of_every_suite_are_cut_and_joined_again(suite: Suite) -> None:
    """The parts are those of the specification's drawing, and together they are the message."""
    conversation = converse(1, suite, frames=0)
    for datagram, share in (
        (conversation.initiation, suite.share_bytes),
        (conversation.response, suite.ciphertext_bytes),
    ):
        parts = parts_of(datagram)
        assert parts is not None
        assert parts.join() == datagram
        assert parts.suite is suite
        assert len(parts.ephemeral) == 32
        assert len(parts.share) == (share + 16 if share else 0)
        assert len(parts.macs) == 32


def test_mac1_is_the_one_that_the_receiver_checks() -> None:
    """Made with the public key, it passes the core's check; without the key, the datagram is unchanged."""
    altered = CONVERSATION.initiation[:10] + b"x" + CONVERSATION.initiation[11:]
    repaired = with_mac1(altered, CONVERSATION.keys["b"])
    MacKeys(CONVERSATION.keys["b"]).check_mac1(repaired)
    assert repaired[:10] == altered[:10]
    assert with_mac1(CONVERSATION.initiation, CONVERSATION.keys["b"]) == CONVERSATION.initiation
    assert with_mac1(altered, None) == altered
    assert with_mac1(b"short", CONVERSATION.keys["b"]) == b"short"


def test_frames_are_read_where_they_are_readable() -> None:
    """In the authenticated mode the message IDs are readable; in the confidential mode they are not."""
    readable = [message_ids(envelope) for envelope in CONVERSATION.envelopes()]
    assert (0,) in readable
    assert (30,) in readable
    header, tag = b"\x40\x00\x01\x00\x02", bytes(16)
    assert message_ids(header + HEARTBEAT + ATTITUDE + tag) == (0, 30)
    assert message_ids(header + ATTITUDE[:-1] + tag) == ()
    v1 = b"\xfe\x09\x00\x01\x01\x00" + bytes(11)
    assert message_ids(header + v1 + tag) == (0,)
    assert not any(map(message_ids, converse(2, confidential=True).envelopes()))


def test_cookie_shows_in_mac2() -> None:
    """Without a cookie mac2 is zero."""
    assert not anatomy.has_cookie(CONVERSATION.initiation)
    assert anatomy.has_cookie(CONVERSATION.initiation[:-1] + b"\x01")
    assert not anatomy.has_cookie(b"\x40" * 40)


def test_frames_of_the_attackers_own_are_mavlink() -> None:
    """What raw-mavlink and forge-data send is what an autopilot would obey, as pymavlink reads it."""
    parser = mavlink.MAVLink(None)
    read = {name: parser.decode(bytearray(frame)) for name, frame in COMMAND_FRAMES}
    assert read["HEARTBEAT"].get_type() == "HEARTBEAT"
    assert (read["disarm"].command, read["disarm"].param1) == (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0)
    termination = read["flight termination"]
    assert (termination.command, termination.param1) == (mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 1)
    assert read["SET_MODE"].custom_mode == 6


@given(st.binary(max_size=1400), st.sampled_from([None, bytes(32)]))
def test_nothing_raises_whatever_the_bytes(data: bytes, key: bytes | None) -> None:
    """The functions accept any bytes, and unchanged parts join to the same bytes."""
    parts = parts_of(data)
    assert parts is None or parts.join() == data
    envelope_of(data)
    message_ids(data)
    anatomy.has_cookie(data)
    assert len(with_mac1(data, key)) == len(data)
