"""Floods, probes and false notices are what they claim to be, and what comes back is counted."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, play, sends
from uavlinkd.core import wire
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.drops import Drop
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.mitm.attack import Send, What
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.attacks.floods import AmplificationProbe

CONVERSATION = converse()
SAID = CONVERSATION.said


@pytest.mark.parametrize("mac1", ["valid", "bad"])
@pytest.mark.parametrize("suite", ["x25519", "mlkem768"])
def test_flooding_initiations_are_whole_and_all_different(mac1: str, suite: str) -> None:
    """They parse; with the public key their mac1 is right; each has a key of its own, from many addresses."""
    attack = parse_attack(f"flood-initiations,mac1={mac1},suite={suite},seconds=0.5").make(CONVERSATION.surroundings)
    flood = sends(play(attack, []))
    assert len(flood) == 250
    assert len({each.stranger for each in flood}) > 32
    assert len({wire.parse_initiation(each.datagram).ephemeral for each in flood}) == 250
    for each in flood:
        assert wire.parse_initiation(each.datagram).suite is SUITES_BY_NAME[suite]
        check = MacKeys(CONVERSATION.keys[each.way.receiver]).check_mac1
        if mac1 == "valid":
            check(each.datagram)
        else:
            with pytest.raises(Drop):
                check(each.datagram)


def test_flood_without_strangers_comes_under_the_peers_address() -> None:
    """sources=0."""
    attack = parse_attack("flood-initiations,sources=0").make(CONVERSATION.surroundings)
    assert {each.stranger for each in sends(play(attack, []))} == {None}


def test_flood_of_replays_sends_what_was_recorded() -> None:
    """Initiations of that way alone; without any, nothing."""
    attack = parse_attack("flood-replays").make(CONVERSATION.surroundings)
    assert play(attack, []) == []
    flood = [each for each in sends(play(attack, SAID)) if each.stranger is not None]
    assert {(each.datagram, each.way) for each in flood} == {(CONVERSATION.initiation, AB)}
    assert len(flood) > 100


def test_garbage_is_of_every_sort() -> None:
    """Empty ones, hostile text, garbage behind a known type, and plain garbage."""
    attack = parse_attack("flood-garbage").make(CONVERSATION.surroundings)
    flood = [each.datagram for each in sends(play(attack, []))]
    assert b"" in flood
    assert any(b"\x1b[2J" in each for each in flood)
    assert {each[0] for each in flood if each} >= {1, 2, 3, 0x40, 0x41, 0xFD, 0xFE}
    assert max(map(len, flood)) > 1000


def test_scan_tries_every_first_byte_at_several_lengths() -> None:
    """To both peers."""
    attack = parse_attack("stranger-scan,rate_per_s=1000").make(CONVERSATION.surroundings)
    tried = {(each.way, each.datagram[0], len(each.datagram)) for each in sends(play(attack, []))}
    assert {kind for _, kind, _ in tried} == set(range(256))
    assert {way for way, _, _ in tried} == {AB, BA}
    assert {length for _, kind, length in tried if kind == 1} >= {1, 5, 13, 52, 103, 147, 1232}


def test_probe_tells_when_more_comes_back_than_was_sent() -> None:
    """It counts by peer and address, and says so when an answer is longer than the question."""
    attack = parse_attack("amplification-probe").make(CONVERSATION.surroundings)
    assert isinstance(attack, AmplificationProbe)
    (question,) = sends(attack.due(0.0))
    assert question.stranger is not None
    peer = question.way.receiver
    fair = attack.on_answer(bytes(len(question.datagram)), peer, question.stranger, 0.1)
    assert [each.what for each in notes(fair)] == [What.ANSWERED]
    assert attack.amplified == []
    unfair = attack.on_answer(b"\x03", peer, question.stranger, 0.2)
    assert "amplified" in notes(unfair)[-1].detail
    assert attack.amplified == [(peer, question.stranger)]


def test_probe_asks_in_every_way() -> None:
    """Initiations of its own, recorded datagrams, and recorded datagrams cut short; each of both peers."""
    attack = parse_attack("amplification-probe").make(CONVERSATION.surroundings)
    asked = {(each.way, each.detail.split(", from")[0]) for each in notes(play(attack, SAID))}
    assert asked == {(way, what) for way in (AB, BA) for what in ("initiation", "recorded", "recorded, cut short")}


def test_hints_are_envelopes_of_no_session_from_the_peers_address() -> None:
    """They parse, under indices by chance."""
    attack = parse_attack("forge-hints").make(CONVERSATION.surroundings)
    hints = sends(play(attack, []))
    assert {each.stranger for each in hints} == {None}
    assert len({wire.parse_envelope_header(each.datagram)[0] for each in hints}) > 100


def test_false_cookies_name_the_message_that_they_answer() -> None:
    """Whole cookie replies to the sender, with its index; the message passes in front of them."""
    attack = parse_attack("forge-cookie,copies=3").make(CONVERSATION.surroundings)
    genuine, *false = sends(attack.on_datagram(CONVERSATION.initiation, AB, 0.0))
    assert genuine == Send(CONVERSATION.initiation, AB)
    assert len({each.datagram for each in false}) == 3
    for each in false:
        assert each.way == BA
        reply = wire.parse_cookie_reply(each.datagram)
        assert reply.receiver_index == wire.parse_initiation(CONVERSATION.initiation).sender_index


def test_answers_are_counted_and_told() -> None:
    """Whatever a peer sends to an address of the flood's."""
    attack = parse_attack("flood-initiations").make(CONVERSATION.surroundings)
    (told,) = notes(attack.on_answer(b"\x03" + bytes(51), "b", 7, 0.0))
    assert (told.what, told.way, told.kind, told.detail) == (What.ANSWERED, BA, "cookie", "to stranger 7")
