"""Attacks that stretch time: which datagrams pass, when, and in which order."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, sends
from uavlinkd.core import wire
from uavlinkd.lab.mitm.attack import NEVER, Operation, Send
from uavlinkd.lab.mitm.attacks import parse_attack, stretch

CONVERSATION = converse(1)
ENVELOPES = [
    datagram for datagram, direction in CONVERSATION.said if direction == AB and datagram[0] == wire.SHORT_ENVELOPE
]


def test_one_envelope_passes_each_interval_in_the_order_sent() -> None:
    """The first after one interval; what is sent meanwhile waits behind it."""
    attack = parse_attack("stretch,interval_s=2").make(CONVERSATION.context)
    for number, envelope in enumerate(ENVELOPES[:3]):
        assert sends(attack.on_datagram(envelope, AB, number / 10)) == []
    assert attack.next_deadline() == 2.0
    assert sends(attack.due(1.9)) == []
    assert sends(attack.due(2.0)) == [Send(ENVELOPES[0], AB)]
    assert sends(attack.due(4.0)) == [Send(ENVELOPES[1], AB)]
    assert sends(attack.due(6.0)) == [Send(ENVELOPES[2], AB)]
    assert attack.next_deadline() == NEVER


@pytest.mark.parametrize("blocks", [True, False])
def test_handshake_messages_are_dropped_in_both_directions(blocks: bool) -> None:
    """Also where one direction alone is delayed; on request they pass."""
    text = f"stretch,direction=a>b,block_handshakes={str(blocks).lower()}"
    attack = parse_attack(text).make(CONVERSATION.context)
    for datagram, direction in ((CONVERSATION.initiation, AB), (CONVERSATION.response, BA)):
        actions = attack.on_datagram(datagram, direction, 0.0)
        assert sends(actions) == ([] if blocks else [Send(datagram, direction)])
        assert [note.operation for note in notes(actions)] == ([Operation.DROPPED] if blocks else [])


def test_other_direction_of_a_stretched_one_passes() -> None:
    """Both directions are stretched only if selected; after its end, no datagram is delayed."""
    attack = parse_attack("stretch,direction=a>b,seconds=5").make(CONVERSATION.context)
    assert sends(attack.on_datagram(ENVELOPES[0], BA, 0.0)) == [Send(ENVELOPES[0], BA)]
    assert sends(attack.on_datagram(ENVELOPES[0], AB, 5.0)) == [Send(ENVELOPES[0], AB)]


@pytest.mark.parametrize("tag_bytes", wire.TAG_LENGTHS)
@pytest.mark.parametrize("is_reply", [True, False])
def test_echo_records_of_the_other_direction_are_dropped_by_their_length(is_reply: bool, tag_bytes: int) -> None:
    """Encrypted or not, with each length of tag; frames pass there."""
    attack = parse_attack("stretch-one-way,direction=a>b").make(CONVERSATION.context)
    record = wire.Echo(is_reply, 1, 2, 3).encode()
    echo = wire.envelope_header(7, 9) + record + bytes(tag_bytes)
    assert sends(attack.on_datagram(echo, BA, 0.0)) == []
    assert sends(attack.on_datagram(echo + bytes(9), BA, 0.0)) == [Send(echo + bytes(9), BA)]
    assert sends(attack.on_datagram(b"\xfd", BA, 0.0)) == [Send(b"\xfd", BA)]


def test_whole_other_direction_can_be_blocked() -> None:
    """All datagrams of the other direction are dropped."""
    attack = parse_attack("stretch-one-way,direction=a>b,back=all").make(CONVERSATION.context)
    assert sends(attack.on_datagram(ENVELOPES[0], BA, 0.0)) == []


def test_share_of_the_envelopes_passes_at_once() -> None:
    """Those that are not chosen are not delayed."""
    attack = parse_attack("stretch,skip=1").make(CONVERSATION.context)
    assert sends(attack.on_datagram(ENVELOPES[0], AB, 0.0)) == [Send(ENVELOPES[0], AB)]
    assert sends(attack.on_datagram(ENVELOPES[1], AB, 0.0)) == []


def test_queue_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not fit is dropped: if it passed at once, others would overtake the queue."""
    monkeypatch.setattr(stretch, "HELD_LIMIT", 2)
    attack = parse_attack("stretch").make(CONVERSATION.context)
    whats = [note.operation for one in ENVELOPES[:3] for note in notes(attack.on_datagram(one, AB, 0.0))]
    assert whats == [Operation.HELD, Operation.HELD, Operation.DROPPED]
