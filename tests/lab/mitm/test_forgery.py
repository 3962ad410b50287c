"""Each attack on datagrams and envelopes tries every position, length and join."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.lab.mitm.samples import AB, BA, Conversation, converse, notes, play, sends
from uavlinkd.core import wire
from uavlinkd.core.constants import SESSION_ENVELOPE_LIMIT
from uavlinkd.core.cookie import MacKeys
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


def test_bit_flip_in_handshakes_may_repair_mac1() -> None:
    """A flip before the MACs reaches the cryptography; a flip in a MAC is not repaired."""
    initiation = CONVERSATION.initiation
    flipped = _altered("bit-flip,kinds=initiation,repair_mac1=true", [initiation] * len(initiation))
    for at, datagram in enumerate(flipped[1:115], 1):
        if at != 0:
            MacKeys(CONVERSATION.keys["b"]).check_mac1(datagram)
            assert datagram[at] ^ initiation[at] == 1
    assert flipped[120][:115] == initiation[:115]
    assert flipped[120] != initiation


def test_truncate_goes_through_every_length() -> None:
    """From one byte less to an empty datagram."""
    assert _altered("truncate", [ENVELOPE] * len(ENVELOPE)) == [ENVELOPE[:-n] for n in range(1, len(ENVELOPE) + 1)]


def test_extend_goes_through_every_length() -> None:
    """One byte more, two bytes more, and from the start again."""
    extended = _altered("extend,at_most=5", [ENVELOPE] * 6)
    assert [len(datagram) - len(ENVELOPE) for datagram in extended] == [1, 2, 3, 4, 5, 1]
    assert all(datagram.startswith(ENVELOPE) for datagram in extended)


def test_splice_joins_two_envelopes_in_every_way() -> None:
    """Body, header, tag, both in one: each from the envelope before."""
    given = CONVERSATION.envelopes()[4:9]
    first, *spliced = _altered("splice", given)
    assert first == given[0]  # nothing came before it
    body, header, tag, both = spliced
    assert body == given[1][:5] + given[0][5:]
    assert header == given[1][:5] + given[2][5:]
    assert tag == given[3][:-8] + given[2][-8:]
    assert both == given[4] + given[3]


def test_splice_ignores_equal_envelopes() -> None:
    """An equal header changes nothing: the datagram passes, and is neither logged nor counted."""
    attack = parse_attack("splice,join=header").make(CONVERSATION.context)
    altered = ENVELOPE[:-1] + bytes((ENVELOPE[-1] ^ 1,))
    attack.on_datagram(altered, AB, 0.0)
    assert attack.on_datagram(ENVELOPE, AB, 0.0) == [Send(ENVELOPE, AB)]
    assert attack.attempts == 0


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


def test_alter_frame_alters_payload_alone() -> None:
    """One byte between header and tag, the longest tag there may be."""
    for before, after in zip(
        CONVERSATION.envelopes()[3:], _altered("alter-frame", CONVERSATION.envelopes()[3:]), strict=True
    ):
        differ = [n for n in range(len(before)) if before[n] != after[n]]
        assert len(differ) == 1
        assert 5 <= differ[0] < len(before) - 32


def test_tamper_tag_makes_every_invalid_tag() -> None:
    """Zeros, random bytes, 8 bytes, 32 bytes, no tag; the signed bytes are unchanged."""
    zero, random, short, long, none = _altered("tamper-tag", [ENVELOPE] * 5)
    assert zero == ENVELOPE[:-16] + bytes(16)
    assert random[:-16] == ENVELOPE[:-16]
    assert random[-16:] not in (ENVELOPE[-16:], bytes(16))
    assert short == ENVELOPE[:-8]
    assert long.startswith(ENVELOPE)
    assert len(long) == len(ENVELOPE) + 16
    assert none == ENVELOPE[:-16]


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


def test_forge_data_waits_for_a_session() -> None:
    """Without an observed envelope, the attack is inactive."""
    attack = parse_attack("forge-data").make(CONVERSATION.context)
    assert play(attack, []) == []
    assert attack.attempts == 0


def test_envelope_flood_keeps_its_rate() -> None:
    """A thousand a second, from many addresses."""
    attack = parse_attack("flood-envelopes,origin=stranger,seconds=2").make(CONVERSATION.context)
    flood = [send for send in sends(play(attack, CONVERSATION.said)) if send.stranger is not None]
    assert 1900 < len(flood) <= 2000
    assert len({send.stranger for send in flood}) == 64


def test_raw_mavlink_goes_to_both_peers_from_peers_and_strangers() -> None:
    """Bare frames, each with its name in the log."""
    attack = parse_attack("raw-mavlink").make(CONVERSATION.context)
    actions = play(attack, [])
    assert {send.datagram[0] for send in sends(actions)} == {0xFD}
    kinds = {"HEARTBEAT", "disarm", "flight termination", "SET_MODE"}
    assert {note.detail.split(",")[0] for note in notes(actions)} == kinds
    origins = {(send.direction, send.stranger is None) for send in sends(actions)}
    assert origins == {(direction, is_peer) for direction in (AB, BA) for is_peer in (True, False)}


def test_forged_data_comes_to_both_peers_from_peers_and_strangers() -> None:
    """Alternating per direction, so that each peer gets both."""
    attack = parse_attack("forge-data").make(CONVERSATION.context)
    said = {datagram for datagram, _ in CONVERSATION.said}
    forged = [send for send in sends(play(attack, CONVERSATION.said)) if send.datagram not in said]
    origins = Counter((send.direction, send.stranger is None) for send in forged)
    assert len(origins) == 4
    assert max(origins.values()) - min(origins.values()) <= 3
