"""Each attack drops, holds or reorders only the selected datagrams."""

from __future__ import annotations

import pytest

from tests.lab.mitm.samples import AB, ATTITUDE, BA, HEARTBEAT, converse, notes, play, sends
from uavlinkd.lab.mitm.attack import NEVER, Send
from uavlinkd.lab.mitm.attacks import parse_attack

CONVERSATION = converse()
SAID = CONVERSATION.said


def _dropped(text: str, said: list[tuple[bytes, tuple[str, str]]] | None = None) -> list[bytes]:
    """What does not pass."""
    given = SAID if said is None else said
    passed = [send.datagram for send in sends(play(parse_attack(text).make(CONVERSATION.context), given))]  # type: ignore[arg-type]
    return [datagram for datagram, _ in given if datagram not in passed]


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("initiation", [CONVERSATION.initiation]),
        ("response", [CONVERSATION.response]),
        ("confirmation", [CONVERSATION.envelopes()[0]]),
        ("cookie", []),
    ],
)
def test_drop_message_drops_exactly_that_message(message: str, expected: list[bytes]) -> None:
    """One datagram of the conversation is missing, or none without such a message."""
    assert _dropped(f"drop-message,message={message}") == expected


def test_drop_message_drops_cookies() -> None:
    """A cookie reply is one by its first byte."""
    attack = parse_attack("drop-message,message=cookie").make(CONVERSATION.context)
    assert sends(attack.on_datagram(b"\x03" + bytes(51), AB, 0.0)) == []


def test_drop_heartbeats_reads_the_frames() -> None:
    """Exactly the envelopes with a HEARTBEAT; with another number, those with that message."""
    with_heartbeat = [datagram for datagram, _ in SAID if HEARTBEAT in datagram]
    with_attitude = [datagram for datagram, _ in SAID if ATTITUDE in datagram]
    assert len(with_heartbeat) == 8
    assert _dropped("drop-heartbeats") == with_heartbeat
    assert _dropped("drop-heartbeats,message_id=30") == with_attitude


def test_drop_heartbeats_goes_by_size_where_nothing_is_readable() -> None:
    """Encrypted heartbeats differ from encrypted attitudes in length."""
    encrypted = converse(8, confidential=True)
    attack = parse_attack("drop-heartbeats").make(encrypted.context)
    actions = play(attack, encrypted.said)
    assert [note.detail for note in notes(actions)] == ["by its size"] * 8
    assert {note.length for note in notes(actions)} == {5 + len(HEARTBEAT) + 16}


def test_block_rekey_lets_envelopes_pass() -> None:
    """Only the two handshake messages are missing."""
    assert _dropped("block-rekey") == [CONVERSATION.initiation, CONVERSATION.response]


def test_blackout_lets_nothing_pass_for_its_time() -> None:
    """From half a second on, for a tenth of one."""
    attack = parse_attack("blackout,begin_s=0.5,seconds=0.1").make(CONVERSATION.context)
    reported = notes(play(attack, SAID))
    assert [note.number for note in reported] == list(range(51, 61))


def test_hold_releases_unaltered_and_in_order_when_the_time_is_up() -> None:
    """After 30 s each is released in order; handshakes pass immediately."""
    attack = parse_attack("hold").make(CONVERSATION.context)
    now, passed = 0.0, []
    for datagram, direction in SAID:
        passed += sends(attack.on_datagram(datagram, direction, now))
        now += 0.01
    assert [send.datagram for send in passed] == [CONVERSATION.initiation, CONVERSATION.response]
    assert attack.next_deadline() == pytest.approx(30.02)
    assert sends(attack.due(30.019)) == []
    released = sends(attack.due(40.0))
    assert [(send.datagram, send.direction) for send in released] == SAID[2:]
    assert attack.next_deadline() == NEVER


def test_initiations_cross_when_both_sides_send_one() -> None:
    """The first is held until that of the other peer; then both are sent."""
    attack = parse_attack("cross-initiations").make(CONVERSATION.context)
    other = converse(9, frames=0).initiation
    assert sends(attack.on_datagram(CONVERSATION.initiation, AB, 0.0)) == []
    crossed = sends(attack.on_datagram(other, BA, 0.2))
    assert crossed == [Send(CONVERSATION.initiation, AB), Send(other, BA)]
    assert attack.next_deadline() == NEVER


def test_initiation_that_stays_alone_is_released() -> None:
    """After a second."""
    attack = parse_attack("cross-initiations").make(CONVERSATION.context)
    attack.on_datagram(CONVERSATION.initiation, AB, 5.0)
    assert attack.next_deadline() == 6.0
    assert sends(attack.due(6.0)) == [Send(CONVERSATION.initiation, AB)]


def test_reorder_sends_everything_once_in_another_order() -> None:
    """Each batch of a direction is whole, and not as it was."""
    attack = parse_attack("reorder,depth=8").make(CONVERSATION.context)
    sent = sends(play(attack, SAID))
    assert sorted(sent) == sorted(Send(datagram, direction) for datagram, direction in SAID)
    before, after = (
        CONVERSATION.envelopes(),
        [send.datagram for send in sent if send.direction == AB and send.datagram[0] == 0x40],
    )
    for begin in range(0, 40, 8):
        assert sorted(before[begin : begin + 8]) == sorted(after[begin : begin + 8])
        assert before[begin : begin + 8] != after[begin : begin + 8]


def test_reorder_sends_an_incomplete_batch() -> None:
    """What is gathered is sent after its patience, also where no batch fills."""
    attack = parse_attack("reorder,depth=100,patience_s=0.3").make(CONVERSATION.context)
    attack.on_datagram(SAID[2][0], AB, 1.0)
    attack.on_datagram(SAID[4][0], AB, 1.1)
    assert attack.next_deadline() == pytest.approx(1.3)
    assert [send.datagram for send in sends(attack.due(1.3))] == [SAID[4][0], SAID[2][0]]
