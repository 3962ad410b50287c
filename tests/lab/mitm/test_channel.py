"""A chain of attacks, then a radio: in order."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, BA, converse, notes, sends
from uavlinkd.core.relay_records import wrap
from uavlinkd.lab.mitm.attack import NEVER, AttackObject, Send
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.radio import RadioSettings

CONVERSATION = converse()
ENVELOPE = CONVERSATION.envelopes()[3]


def _channel(*attacks: str, radio: RadioSettings | None = None, seed: int = 0) -> AttackChannel:
    made = [parse_attack(attack).make(CONVERSATION.context, seed) for attack in attacks]
    return AttackChannel(CONVERSATION.context, made, {AB: radio} if radio else None, seed)


def test_later_attack_meets_what_the_earlier_one_lets_pass() -> None:
    """What is doubled first is altered twice; what is dropped first is not altered."""
    doubled = _channel("duplicate", "extend").on_datagram(ENVELOPE, AB, 0.0)
    assert [len(send.datagram) - len(ENVELOPE) for send in sends(doubled)] == [1, 2]
    dropped = _channel("drop", "extend").on_datagram(ENVELOPE, AB, 0.0)
    assert sends(dropped) == []
    assert {note.attack for note in notes(dropped)} == {"drop"}


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


def _inside(text: str) -> AttackObject:
    return parse_attack(f"{text},inside=true").place(CONVERSATION.context)


def test_attack_sees_inner_datagrams_and_keeps_their_header() -> None:
    """The handle is that of the direction."""
    attack = _inside("extend")
    (sent,) = sends(attack.on_datagram(wrap(7, ENVELOPE), AB, 0.0))
    assert sent.datagram[:-1] == wrap(7, ENVELOPE)
    assert attack.name == "extend"


def test_other_datagrams_pass() -> None:
    """Those of the session with the relay, data without a datagram, and data inside data."""
    attack = _inside("drop,kinds=any")
    for datagram in (ENVELOPE, b"", wrap(7, b""), wrap(7, wrap(8, ENVELOPE))):
        assert attack.on_datagram(datagram, AB, 0.0) == [Send(datagram, AB)]
    dropped = attack.on_datagram(wrap(7, ENVELOPE), AB, 0.0)
    assert (sends(dropped), len(notes(dropped))) == ([], 1)
    assert attack.on_answer(ENVELOPE, "a", 1, 0.0) == []


def test_attack_waits_for_a_handle() -> None:
    """Before data came, there is nothing to send with; later only in the directions with data."""
    attack = _inside("raw-mavlink,rate_per_s=100")
    assert (attack.next_deadline(), attack.due(1.0)) == (NEVER, [])
    attack.on_datagram(wrap(7, ENVELOPE), AB, 1.0)
    assert attack.next_deadline() < 2.0
    sent = sends(attack.due(2.0))
    assert sent
    assert {(send.direction, send.datagram[:3]) for send in sent} == {(AB, wrap(7, b""))}
    attack.on_datagram(wrap(9, ENVELOPE), BA, 2.0)
    later = {(send.direction, send.datagram[:3]) for send in sends(attack.due(3.0))}
    assert later == {(AB, wrap(7, b"")), (BA, wrap(9, b""))}
