"""Replays have the configured time, direction and source, and are byte for byte as recorded."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, play, sends
from uavlinkd.lab.mitm.attack import Action, Direction, Operation, Send
from uavlinkd.lab.mitm.attacks import parse_attack

CONVERSATION = converse()
SAID = CONVERSATION.said
COOKIE = b"\x03" + bytes(51)


def _again(actions: list[Action], said: list[tuple[bytes, Direction]]) -> list[Send]:
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


ENVELOPE = CONVERSATION.envelopes()[3]
ANSWER = b"\x40answer"


@pytest.mark.parametrize(
    ("mode", "expected", "carried"),
    [
        ("race", [Send(ENVELOPE, AB, 0), Send(ENVELOPE, AB)], []),
        ("instead", [Send(ENVELOPE, AB, 0)], []),
        ("relay", [Send(ENVELOPE, AB, 0)], [Send(ANSWER, BA, 1)]),
    ],
)
def test_roam_forwards_from_a_third_address(mode: str, expected: list[Send], carried: list[Send]) -> None:
    """One stranger per direction; only a relay returns answers, from the stranger of the other direction."""
    attack = parse_attack(f"roam,mode={mode}").make(CONVERSATION.context)
    assert sends(attack.on_datagram(ENVELOPE, AB, 0.0)) == expected
    answered = attack.on_answer(ANSWER, "b", 0, 0.1)
    assert sends(answered) == carried
    assert [note.operation for note in notes(answered)] == [Operation.ANSWERED]
