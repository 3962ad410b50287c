"""A chain of attacks, then a radio: in order; a pause passes all datagrams."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, sends
from uavlinkd.lab.mitm.attack import NEVER, Action, Send
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.radio import Outcome, RadioSettings

CONVERSATION = converse()
ENVELOPE = CONVERSATION.envelopes()[3]


def _channel(*attacks: str, radio: RadioSettings | None = None, seed: int = 0) -> AttackChannel:
    made = [parse_attack(attack).make(CONVERSATION.context, seed) for attack in attacks]
    return AttackChannel(CONVERSATION.context, made, {AB: radio} if radio else None, seed)


def test_empty_channel_is_a_cable() -> None:
    """Everything passes at once and unaltered."""
    channel = _channel()
    for datagram, direction in CONVERSATION.said:
        assert channel.on_datagram(datagram, direction, 0.0) == [Send(datagram, direction)]
    assert channel.next_deadline() == NEVER


def test_later_attack_meets_what_the_earlier_one_lets_pass() -> None:
    """What is doubled first is altered twice; what is dropped first is not altered."""
    doubled = _channel("duplicate", "extend").on_datagram(ENVELOPE, AB, 0.0)
    assert [len(send.datagram) - len(ENVELOPE) for send in sends(doubled)] == [1, 2]
    dropped = _channel("drop", "extend").on_datagram(ENVELOPE, AB, 0.0)
    assert sends(dropped) == []
    assert {note.attack for note in notes(dropped)} == {"drop"}


def test_what_comes_from_strangers_meets_no_later_attack() -> None:
    """It does not go along the cable."""
    actions = _channel("replay-data,origin=stranger", "drop").on_datagram(ENVELOPE, AB, 0.0)
    (only,) = sends(actions)
    assert only.stranger is not None


def test_what_an_attack_sends_by_itself_meets_the_later_ones() -> None:
    """A flood from the peer's address passes the drop."""
    channel = _channel("raw-mavlink,origin=sender", "drop")
    actions = channel.due(0.0)
    assert sends(actions) == []
    assert [note.attack for note in notes(actions)] == ["drop", "raw-mavlink"]


def test_radio_is_behind_the_attacks() -> None:
    """An altered datagram takes the radio's time; the other direction has no radio."""
    channel = _channel("extend", radio=RadioSettings(delay_s=0.5))
    assert sends(channel.on_datagram(ENVELOPE, AB, 1.0)) == []
    assert channel.next_deadline() == pytest.approx(1.5)
    (late,) = sends(channel.due(1.5))
    assert len(late.datagram) == len(ENVELOPE) + 1
    assert len(sends(channel.on_datagram(ENVELOPE, BA, 2.0))) == 1


def test_radio_loses_its_share() -> None:
    """It is the emulator of radio.py, with its counters."""
    channel = _channel(radio=RadioSettings(loss=0.5))
    passed = sum(len(sends(channel.on_datagram(ENVELOPE, AB, 0.0))) for _ in range(1000))
    assert channel.radios[AB].outcomes[Outcome.LOST] == 1000 - passed
    assert 400 < passed < 600


def test_paused_channel_attacks_nothing_and_goes_on_afterwards() -> None:
    """Datagrams pass, floods stop, what is held waits; then all as before."""
    channel = _channel("hold,hold_s=1", "raw-mavlink,begin_s=5")
    channel.on_datagram(ENVELOPE, AB, 0.0)
    channel.is_paused = True
    assert channel.next_deadline() == NEVER
    assert channel.on_datagram(ENVELOPE, BA, 0.5) == [Send(ENVELOPE, BA)]
    assert channel.due(3.0) == []
    assert channel.on_answer(b"x", "a", 0, 3.0) == []
    channel.is_paused = False
    assert [(send.datagram, send.direction) for send in sends(channel.due(3.0))] == [(ENVELOPE, AB)]


class _Mirror:
    """Any object with the four methods is an attack: here one that reflects everything."""

    name = "mirror"

    def on_datagram(self, datagram: bytes, direction: object, now: float) -> list[Action]:
        return [Send(datagram, BA)]

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        return [Send(datagram, AB)]

    def due(self, now: float) -> list[Action]:
        return []

    def next_deadline(self) -> float:
        return NEVER


def test_foreign_attack_object_is_taken() -> None:
    """It needs none of our base classes."""
    channel = AttackChannel(CONVERSATION.context, [_Mirror()])
    assert channel.on_datagram(ENVELOPE, AB, 0.0) == [Send(ENVELOPE, BA)]
    assert channel.on_answer(b"x", "a", 3, 0.0) == [Send(b"x", AB)]


def test_same_seed_gives_the_same_channel() -> None:
    """Attacks and radios together."""
    runs: list[list[list[Action]]] = []
    for _ in range(2):
        channel = _channel(
            "bit-flip,share=0.5", "duplicate,share=0.3", radio=RadioSettings(loss=0.2, jitter_s=0.1), seed=5
        )
        runs.append(
            [
                channel.on_datagram(datagram, direction, n * 0.01)
                for n, (datagram, direction) in enumerate(CONVERSATION.said)
            ]
        )
        runs[-1].append(channel.due(10.0))
    assert runs[0] == runs[1]
