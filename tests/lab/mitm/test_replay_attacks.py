"""Replays have the configured time, direction and source, and are byte for byte as recorded."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, play, sends
from uavlinkd.lab.mitm.attack import NEVER, Action, AttackContext, AttackObject, Direction, Operation, Send
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.attacks.replays import RECORD_LIMIT

CONVERSATION = converse()
SAID = CONVERSATION.said
COOKIE = b"\x03" + bytes(51)


def _again(actions: list[Action], said: list[tuple[bytes, Direction]]) -> list[Send]:
    """The injected datagrams only."""
    sent = sends(actions)
    for datagram, direction in said:
        sent.remove(Send(datagram, direction))
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
    """Each such datagram is sent once more, unaltered, in its direction."""
    said = [*SAID, (COOKIE, BA)]
    again = _again(play(parse_attack(name).make(CONVERSATION.context), said), said)
    assert again == [Send(datagram, direction) for datagram, direction in said if datagram[0] in first_bytes]


def test_reflection_goes_back_to_the_sender() -> None:
    """Along the other way, from where the other peer is for it."""
    again = _again(play(parse_attack("reflect").make(CONVERSATION.context), SAID), SAID)
    assert again == [Send(datagram, direction.reverse) for datagram, direction in SAID]


def test_misrouted_datagrams_go_to_a_third_peer() -> None:
    """Under the sender's address."""
    attack = parse_attack("misroute").make(AttackContext.between("a", "b", "c"))
    actions = play(attack, SAID)
    assert _again(actions, SAID) == [Send(datagram, Direction(direction.sender, "c")) for datagram, direction in SAID]
    assert {note.operation for note in notes(actions)} == {Operation.MISROUTED}


def test_copies_and_strangers() -> None:
    """Five copies, each from an address of the attacker's own."""
    attack = parse_attack("replay-initiation,copies=5,origin=stranger").make(CONVERSATION.context)
    again = _again(play(attack, SAID), SAID)
    assert [send.datagram for send in again] == [CONVERSATION.initiation] * 5
    assert all(send.stranger is not None for send in again)


def test_stolen_cookie_replays_only_handshakes_with_mac2() -> None:
    """Only messages with a cookie are replayed, from a stranger."""
    with_cookie = CONVERSATION.initiation[:-16] + bytes(range(16))
    said = [(CONVERSATION.initiation, AB), (with_cookie, AB)]
    (again,) = _again(play(parse_attack("stolen-cookie").make(CONVERSATION.context), said), said)
    assert again.datagram == with_cookie
    assert again.stranger is not None


def test_later_is_that_much_later() -> None:
    """Not before, and once."""
    attack = parse_attack("replay-data,when=later,delay_s=10").make(CONVERSATION.context)
    envelope = CONVERSATION.envelopes()[0]
    assert attack.on_datagram(envelope, AB, 1.0) == [Send(envelope, AB)]
    assert attack.next_deadline() == 11.0
    assert attack.due(10.99) == []
    assert sends(attack.due(11.0)) == [Send(envelope, AB)]
    assert attack.next_deadline() == NEVER


def _drain(attack: AttackObject) -> list[Send]:
    result: list[Send] = []
    while attack.next_deadline() < NEVER:
        result += sends(attack.due(attack.next_deadline()))
    return result


def test_rekey_is_the_next_response() -> None:
    """Datagrams under the old keys are replayed after the next response."""
    attack = parse_attack("replay-data,when=rekey").make(CONVERSATION.context)
    play(attack, SAID, after_s=0)
    assert attack.next_deadline() == NEVER
    attack.on_datagram(converse(9).response, BA, 100.0)
    assert attack.next_deadline() == 100.5
    assert _drain(attack) == [Send(datagram, direction) for datagram, direction in SAID if datagram[0] == 0x40]


def test_restart_is_an_initiation_after_silence() -> None:
    """Its sent and received datagrams are replayed; a peer without a silence did not restart."""
    attack = parse_attack("replay-data,when=restart").make(CONVERSATION.context)
    play(attack, SAID, interval_s=0.001, after_s=0)
    initiation = converse(9).initiation
    attack.on_datagram(initiation, AB, 0.2)
    assert attack.next_deadline() == NEVER
    attack.on_datagram(initiation, AB, 5.0)
    assert attack.next_deadline() == 5.5
    assert _drain(attack) == [Send(datagram, direction) for datagram, direction in SAID if datagram[0] == 0x40]


def test_memory_of_a_recorder_is_bounded() -> None:
    """Beyond the limit the oldest are forgotten, and no more wait to be sent than that."""
    attack = parse_attack("replay-data,when=rekey").make(CONVERSATION.context)
    for number in range(RECORD_LIMIT + 10):
        attack.on_datagram(b"\x40" + number.to_bytes(20, "big"), AB, 0.0)
    attack.on_datagram(CONVERSATION.response, BA, 1.0)
    assert len(_drain(attack)) == RECORD_LIMIT
