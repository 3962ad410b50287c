"""Authentic datagrams come from strangers, and the answers are relayed or not."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, sends
from uavlinkd.lab.mitm.attack import Operation, Send
from uavlinkd.lab.mitm.attacks import parse_attack

CONVERSATION = converse()
ENVELOPE = CONVERSATION.envelopes()[3]
ANSWER = b"\x40answer"


@pytest.mark.parametrize(
    ("mode", "expected", "carried"),
    [
        ("race", [Send(ENVELOPE, AB, 4), Send(ENVELOPE, AB)], []),
        ("instead", [Send(ENVELOPE, AB, 4)], []),
        ("relay", [Send(ENVELOPE, AB, 4)], [Send(ANSWER, BA, 5)]),
    ],
)
def test_roam_forwards_from_a_third_address(mode: str, expected: list[Send], carried: list[Send]) -> None:
    """One stranger per direction; only a relay returns answers, from the stranger of the other direction."""
    attack = parse_attack(f"roam,mode={mode},stranger=4").make(CONVERSATION.context)
    assert sends(attack.on_datagram(ENVELOPE, AB, 0.0)) == expected
    answered = attack.on_answer(ANSWER, "b", 4, 0.1)
    assert sends(answered) == carried
    assert [note.operation for note in notes(answered)] == [Operation.ANSWERED]


def test_roam_ignores_what_came_to_another_address() -> None:
    """The answer belongs to another datagram."""
    attack = parse_attack("roam,mode=relay,stranger=4").make(CONVERSATION.context)
    assert attack.on_answer(ANSWER, "b", 9, 0.0) == []


def test_roam_that_has_stopped_carries_nothing() -> None:
    """It pulls the traffic, then is gone: that is the mischief."""
    attack = parse_attack("roam,mode=relay,seconds=1").make(CONVERSATION.context)
    attack.on_datagram(ENVELOPE, AB, 0.0)
    assert sends(attack.on_answer(ANSWER, "b", 0, 2.0)) == []


def test_wandering_uses_another_address_each_time_and_carries_answers() -> None:
    """As a NAT that gives a new mapping for every datagram."""
    attack = parse_attack("wander,sources=8").make(CONVERSATION.context)
    used = [sends(attack.on_datagram(envelope, AB, 0.0))[0].stranger for envelope in CONVERSATION.envelopes()[:8]]
    assert sorted(stranger for stranger in used if stranger is not None) == list(range(8))
    assert sends(attack.on_answer(ANSWER, "b", 3, 0.0)) == [Send(ANSWER, BA)]
    assert attack.on_answer(ANSWER, "a", 3, 0.0) == []
