"""Each attack on datagrams and envelopes tries every position, length and join."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, Conversation, converse, play, sends
from uavlinkd.core import wire
from uavlinkd.core.constants import SESSION_ENVELOPE_LIMIT
from uavlinkd.lab.mitm.anatomy import envelope_of, message_ids
from uavlinkd.lab.mitm.attack import Send
from uavlinkd.lab.mitm.attacks import parse_attack

CONVERSATION = converse()
ENVELOPE = CONVERSATION.envelopes()[5]


def _altered(text: str, datagrams: list[bytes], conversation: Conversation = CONVERSATION) -> list[bytes]:
    """The altered datagrams, one for each."""
    attack = parse_attack(text).make(conversation.context, 1)
    sent = [sends(attack.on_datagram(datagram, AB, 0.0)) for datagram in datagrams]
    assert all(len(result) == 1 for result in sent)
    return [result[0].datagram for result in sent]


def test_bit_flip_goes_through_every_bit() -> None:
    """As many datagrams as there are bits: each bit is flipped once, alone."""
    bits = 8 * len(ENVELOPE)
    flipped = _altered("bit-flip", [ENVELOPE] * bits)
    differences = [int.from_bytes(ENVELOPE, "big") ^ int.from_bytes(datagram, "big") for datagram in flipped]
    assert sorted(differences) == [1 << n for n in range(bits)]


@pytest.mark.parametrize(
    ("to", "is_so"),
    [
        ("last", lambda old, new: new == SESSION_ENVELOPE_LIMIT - 1),
        ("ahead", lambda old, new: old < new < old + 1000),
        ("back", lambda old, new: (old - new) % SESSION_ENVELOPE_LIMIT < 100 and new != old),
        ("random", lambda old, new: new != old),
    ],
)
def test_counter_jump_writes_another_counter_in_its_own_form(to: str, is_so: object) -> None:
    """The header stays valid, the rest is unchanged, and the genuine envelope follows."""
    assert callable(is_so)
    attack = parse_attack(f"counter-jump,to={to}").make(CONVERSATION.context)
    forged, genuine = sends(attack.on_datagram(ENVELOPE, AB, 0.0))
    assert genuine == Send(ENVELOPE, AB)
    index, counter, header_bytes = wire.parse_envelope_header(forged.datagram)
    before = envelope_of(ENVELOPE)
    assert before is not None
    assert index == before.receiver_index
    assert is_so(before.counter, counter)
    assert forged.datagram[header_bytes:] == ENVELOPE[5:]


def test_forged_data_is_a_command_in_the_session_that_is_used() -> None:
    """The right index, a counter ahead of the last, a frame that an autopilot reads; from peer and strangers."""
    attack = parse_attack("forge-data,rate_per_s=1000").make(CONVERSATION.context)
    forged = [
        send
        for send in sends(play(attack, CONVERSATION.said))
        if (send.datagram, send.direction) not in CONVERSATION.said
    ]
    indices = {direction: envelope_of(CONVERSATION.envelopes(direction)[0]) for direction in (AB, BA)}
    assert len(forged) > 100
    assert {send.direction for send in forged} == {AB, BA}
    assert {send.stranger is None for send in forged} == {True, False}
    for send in forged:
        envelope, genuine = envelope_of(send.datagram), indices[send.direction]
        assert envelope is not None
        assert genuine is not None
        assert envelope.receiver_index == genuine.receiver_index
        assert message_ids(send.datagram)[0] in (0, 11, 76)
