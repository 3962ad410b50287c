"""Replays come when, where and from where they are asked for, byte for byte as they were recorded."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, play, sends
from uavlinkd.lab.mitm.attack import NEVER, Action, AttackObject, Send, Surroundings, Way, What
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.attacks.replays import RECORD_LIMIT

CONVERSATION = converse()
SAID = CONVERSATION.said
COOKIE = b"\x03" + bytes(51)


def _again(actions: list[Action], said: list[tuple[bytes, Way]]) -> list[Send]:
    """What was sent besides what was said."""
    sent = sends(actions)
    for datagram, way in said:
        sent.remove(Send(datagram, way))
    return sent


@pytest.mark.parametrize(
    ("name", "first_bytes"),
    [
        ("replay-initiation", {1}),
        ("replay-response", {2}),
        ("replay-data", {0x40}),
        ("replay-cookie", {3}),
        ("duplicate", {1, 2, 3, 0x40}),
    ],
)
def test_replays_send_again_what_they_name(name: str, first_bytes: set[int]) -> None:
    """Every such datagram once more, unaltered, along its way, and nothing else."""
    said = [*SAID, (COOKIE, BA)]
    again = _again(play(parse_attack(name).make(CONVERSATION.surroundings), said), said)
    assert again == [Send(datagram, way) for datagram, way in said if datagram[0] in first_bytes]


def test_reflection_goes_back_to_the_sender() -> None:
    """Along the other way, from where the other peer is for it."""
    again = _again(play(parse_attack("reflect").make(CONVERSATION.surroundings), SAID), SAID)
    assert again == [Send(datagram, way.back) for datagram, way in SAID]


def test_misrouted_datagrams_go_to_a_third_peer() -> None:
    """Under the sender's address."""
    attack = parse_attack("misroute").make(Surroundings.between("a", "b", "c"))
    actions = play(attack, SAID)
    assert _again(actions, SAID) == [Send(datagram, Way(way.sender, "c")) for datagram, way in SAID]
    assert {each.what for each in notes(actions)} == {What.MISROUTED}


def test_copies_and_strangers() -> None:
    """Five copies, each from an address of the attacker's own."""
    attack = parse_attack("replay-initiation,copies=5,origin=stranger").make(CONVERSATION.surroundings)
    again = _again(play(attack, SAID), SAID)
    assert [each.datagram for each in again] == [CONVERSATION.initiation] * 5
    assert all(each.stranger is not None for each in again)


def test_stolen_cookie_takes_messages_with_mac2() -> None:
    """Those with a cookie come again, from a stranger; those without do not."""
    with_cookie = CONVERSATION.initiation[:-16] + bytes(range(16))
    said = [(CONVERSATION.initiation, AB), (with_cookie, AB)]
    (again,) = _again(play(parse_attack("stolen-cookie").make(CONVERSATION.surroundings), said), said)
    assert again.datagram == with_cookie
    assert again.stranger is not None


def test_later_is_that_much_later() -> None:
    """Not before, and once."""
    attack = parse_attack("replay-data,when=later,delay_s=10").make(CONVERSATION.surroundings)
    envelope = CONVERSATION.envelopes()[0]
    assert attack.on_datagram(envelope, AB, 1.0) == [Send(envelope, AB)]
    assert attack.next_deadline() == 11.0
    assert attack.due(10.99) == []
    assert sends(attack.due(11.0)) == [Send(envelope, AB)]
    assert attack.next_deadline() == NEVER


def _drain(attack: AttackObject) -> list[Send]:
    found: list[Send] = []
    while attack.next_deadline() < NEVER:
        found += sends(attack.due(attack.next_deadline()))
    return found


def test_rekey_is_the_next_response() -> None:
    """What was recorded under the old keys comes when a response has gone by since."""
    attack = parse_attack("replay-data,when=rekey").make(CONVERSATION.surroundings)
    play(attack, SAID, after_s=0)
    assert attack.next_deadline() == NEVER
    attack.on_datagram(converse(9).response, BA, 100.0)
    assert attack.next_deadline() == 100.5
    assert _drain(attack) == [Send(datagram, way) for datagram, way in SAID if datagram[0] == 0x40]


def test_restart_is_an_initiation_after_silence() -> None:
    """What it had sent and was sent comes again; a peer that was heard lately did not restart."""
    attack = parse_attack("replay-data,when=restart").make(CONVERSATION.surroundings)
    play(attack, SAID, interval_s=0.001, after_s=0)
    initiation = converse(9).initiation
    attack.on_datagram(initiation, AB, 0.2)
    assert attack.next_deadline() == NEVER
    attack.on_datagram(initiation, AB, 5.0)
    assert attack.next_deadline() == 5.5
    assert _drain(attack) == [Send(datagram, way) for datagram, way in SAID if datagram[0] == 0x40]


def test_memory_of_a_recorder_is_bounded() -> None:
    """Beyond the limit the oldest are forgotten, and no more wait to be sent than that."""
    attack = parse_attack("replay-data,when=rekey").make(CONVERSATION.surroundings)
    for number in range(RECORD_LIMIT + 10):
        attack.on_datagram(b"\x40" + number.to_bytes(20, "big"), AB, 0.0)
    attack.on_datagram(CONVERSATION.response, BA, 1.0)
    assert len(_drain(attack)) == RECORD_LIMIT
