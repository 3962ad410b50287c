"""Each attack drops, holds or reorders only the selected datagrams."""

from __future__ import annotations

from tests.lab.mitm.samples import ATTITUDE, HEARTBEAT, converse, notes, play, sends
from uavlinkd.lab.mitm.attacks import parse_attack

CONVERSATION = converse()
SAID = CONVERSATION.said


def _dropped(text: str, said: list[tuple[bytes, tuple[str, str]]] | None = None) -> list[bytes]:
    given = SAID if said is None else said
    passed = [send.datagram for send in sends(play(parse_attack(text).make(CONVERSATION.context), given))]  # type: ignore[arg-type]
    return [datagram for datagram, _ in given if datagram not in passed]


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
