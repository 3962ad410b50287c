"""Floods, probes and forged notices have the documented form, and answers are counted."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, play, sends
from uavlinkd.core import wire
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.drops import Drop
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.mitm.attack import Operation, Send
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.attacks.floods import AmplificationProbe

CONVERSATION = converse()
SAID = CONVERSATION.said


@pytest.mark.parametrize("mac1", ["valid", "bad"])
@pytest.mark.parametrize("suite", ["x25519", "mlkem768"])
def test_flooding_initiations_are_whole_and_all_different(mac1: str, suite: str) -> None:
    """They have a valid format and, with the public key, a valid mac1; each has its own key and a random source."""
    attack = parse_attack(f"flood-initiations,mac1={mac1},suite={suite},seconds=0.5").make(CONVERSATION.context)
    flood = sends(play(attack, []))
    assert len(flood) == 250
    assert len({send.stranger for send in flood}) > 32
    assert len({wire.parse_initiation(send.datagram).ephemeral for send in flood}) == 250
    for send in flood:
        assert wire.parse_initiation(send.datagram).suite is SUITES_BY_NAME[suite]
        check = MacKeys(CONVERSATION.keys[send.direction.receiver]).check_mac1
        if mac1 == "valid":
            check(send.datagram)
        else:
            with pytest.raises(Drop):
                check(send.datagram)


def test_flood_without_strangers_comes_under_the_peers_address() -> None:
    """sources=0."""
    attack = parse_attack("flood-initiations,sources=0").make(CONVERSATION.context)
    assert {send.stranger for send in sends(play(attack, []))} == {None}


def test_flood_of_replays_sends_what_was_recorded() -> None:
    """Only initiations of that direction; without any, the flood sends no datagram."""
    attack = parse_attack("flood-replays").make(CONVERSATION.context)
    assert play(attack, []) == []
    flood = [send for send in sends(play(attack, SAID)) if send.stranger is not None]
    assert {(send.datagram, send.direction) for send in flood} == {(CONVERSATION.initiation, AB)}
    assert len(flood) > 100


def test_garbage_is_of_every_sort() -> None:
    """Empty ones, hostile text, garbage behind a known type, and plain garbage."""
    attack = parse_attack("flood-garbage").make(CONVERSATION.context)
    flood = [send.datagram for send in sends(play(attack, []))]
    assert b"" in flood
    assert any(b"\x1b[2J" in datagram for datagram in flood)
    assert {datagram[0] for datagram in flood if datagram} >= {1, 2, 3, 0x40, 0x41, 0xFD, 0xFE}
    assert max(map(len, flood)) > 1000


def test_scan_tries_every_first_byte_at_several_lengths() -> None:
    """To both peers."""
    attack = parse_attack("stranger-scan,rate_per_s=1000").make(CONVERSATION.context)
    tried = {(send.direction, send.datagram[0], len(send.datagram)) for send in sends(play(attack, []))}
    assert {kind for _, kind, _ in tried} == set(range(256))
    assert {direction for direction, _, _ in tried} == {AB, BA}
    assert {length for _, kind, length in tried if kind == 1} >= {1, 5, 13, 52, 103, 147, 1232}


def test_probe_tells_when_more_comes_back_than_was_sent() -> None:
    """It counts by peer and stranger, and logs an answer that is larger than the request."""
    attack = parse_attack("amplification-probe").make(CONVERSATION.context)
    assert isinstance(attack, AmplificationProbe)
    (question,) = sends(attack.due(0.0))
    assert question.stranger is not None
    peer = question.direction.receiver
    fair = attack.on_answer(bytes(len(question.datagram)), peer, question.stranger, 0.1)
    assert [note.operation for note in notes(fair)] == [Operation.ANSWERED]
    assert attack.amplified == []
    unfair = attack.on_answer(b"\x03", peer, question.stranger, 0.2)
    assert "amplified" in notes(unfair)[-1].detail
    assert attack.amplified == [(peer, question.stranger)]


def test_probe_asks_in_every_way() -> None:
    """New initiations, recorded datagrams, and truncated ones, for both peers."""
    attack = parse_attack("amplification-probe").make(CONVERSATION.context)
    asked = {(note.direction, note.detail.split(", from")[0]) for note in notes(play(attack, SAID))}
    assert asked == {
        (direction, operation)
        for direction in (AB, BA)
        for operation in ("initiation", "recorded", "recorded, truncated")
    }


def test_hints_are_envelopes_of_no_session_from_the_peers_address() -> None:
    """They have a valid format and random indices."""
    attack = parse_attack("forge-hints").make(CONVERSATION.context)
    hints = sends(play(attack, []))
    assert {hint.stranger for hint in hints} == {None}
    assert len({wire.parse_envelope_header(send.datagram)[0] for send in hints}) > 100


def test_false_cookies_name_the_message_that_they_answer() -> None:
    """Whole cookie replies to the sender, with its index; the message passes in front of them."""
    attack = parse_attack("forge-cookie,copies=3").make(CONVERSATION.context)
    genuine, *false = sends(attack.on_datagram(CONVERSATION.initiation, AB, 0.0))
    assert genuine == Send(CONVERSATION.initiation, AB)
    assert len({send.datagram for send in false}) == 3
    for send in false:
        assert send.direction == BA
        reply = wire.parse_cookie_reply(send.datagram)
        assert reply.receiver_index == wire.parse_initiation(CONVERSATION.initiation).sender_index


def test_answers_are_counted_and_logged() -> None:
    """Every datagram from a peer to a stranger."""
    attack = parse_attack("flood-initiations").make(CONVERSATION.context)
    (reported,) = notes(attack.on_answer(b"\x03" + bytes(51), "b", 7, 0.0))
    assert (reported.operation, reported.direction, reported.kind, reported.detail) == (
        Operation.ANSWERED,
        BA,
        "cookie",
        "to stranger 7",
    )
