"""Attacks on what is inside data along a relay."""

from __future__ import annotations

from tests.lab.mitm.samples import AB, BA, converse, notes, sends
from uavlinkd.core.relay_records import wrap
from uavlinkd.lab.mitm.attack import NEVER, AttackObject, Send
from uavlinkd.lab.mitm.attacks import parse_attack

CONVERSATION = converse()
ENVELOPE = CONVERSATION.envelopes()[3]


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


def test_without_the_option_an_attack_sees_whole_datagrams() -> None:
    """Data along a relay is of another kind for it."""
    attack = parse_attack("extend").place(CONVERSATION.context)
    assert attack.on_datagram(wrap(7, ENVELOPE), AB, 0.0) == [Send(wrap(7, ENVELOPE), AB)]
