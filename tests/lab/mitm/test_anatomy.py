"""What a datagram shows to someone without keys, and the one thing that can be computed about it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.harness import Pair, datagrams, only, quiet
from tests.lab.mitm.samples import ATTITUDE, HEARTBEAT, Conversation, converse
from uavlinkd.core import constants as c
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.refusals import Refused
from uavlinkd.core.suites import SUITES, Suite
from uavlinkd.core.wire import TAG_LENGTHS
from uavlinkd.lab.mitm import anatomy
from uavlinkd.lab.mitm.anatomy import envelope_of, is_refusal_report, message_ids, parts_of, with_mac1

CONVERSATION = converse()


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


@given(st.binary(max_size=1400), st.sampled_from([None, bytes(32)]))
def test_nothing_raises_whatever_the_bytes(data: bytes, key: bytes | None) -> None:
    """The functions accept any bytes, and unchanged parts join to the same bytes."""
    parts = parts_of(data)
    assert parts is None or parts.join() == data
    envelope_of(data)
    message_ids(data)
    anatomy.has_cookie(data)
    assert len(with_mac1(data, key)) == len(data)


def report(tag_bytes: int = 16, entries: int = 3, *, confidential: bool = False) -> bytes:
    link = quiet(tag_bytes=tag_bytes, confidential=confidential)
    pair = Pair(link_a=link, link_b=link).establish()
    refused = [Refused(76, 400 + number, 4, 1) for number in range(entries)]
    return only(datagrams(pair.b.node.report_refusals(pair.b.peer, refused, 1.0)))


@pytest.mark.parametrize("tag_bytes", TAG_LENGTHS)
@pytest.mark.parametrize("entries", [1, c.REFUSALS_PER_REPORT])
def test_reports_are_recognised(tag_bytes: int, entries: int) -> None:
    """With every tag, from the smallest to the largest."""
    assert is_refusal_report(report(tag_bytes, entries))


@pytest.mark.parametrize("conversation", [converse(), converse(confidential=True)], ids=["clear", "confidential"])
def test_nothing_else_is_a_report(conversation: Conversation) -> None:
    """No other datagram of a conversation, and no truncated report."""
    assert not any(is_refusal_report(datagram) for datagram, _ in conversation.said)
    assert not is_refusal_report(b"")
    assert not is_refusal_report(report()[:-1])
