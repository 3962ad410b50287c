"""Authentic envelopes that an attacker delayed: which are refused, held or delivered."""

from __future__ import annotations

import pytest

from tests.protocol.harness import (
    ELSEWHERE,
    FRAME,
    Pair,
    Side,
    datagrams,
    lively,
    of,
    only,
    payloads,
    probe_in,
    quiet,
    reasons,
    unsealed,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, wire
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Dropped, PeerLost, PeerUp
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.wire import Probe

SILENT = 30.0
"""A moment long after the last received envelope."""


@pytest.fixture
def pair() -> Pair:
    """A session at second 0, with timers for keys and handshakes only."""
    return Pair(link_a=quiet(), link_b=quiet()).establish()


def talk(pair: Pair, begin: float, end: float, interval_s: float = 0.1) -> None:
    """Alpha sends a frame each so often, and each arrives."""
    for number in range(round((end - begin) / interval_s) + 1):
        assert pair.crosses(pair.a, pair.b, begin + number * interval_s)


def numbered(number: int) -> bytes:
    """A frame that differs from others by its number."""
    return FRAME[:-1] + bytes([number])


def frame(side: Side, now: float, number: int = 0) -> bytes:
    """An envelope with a numbered frame."""
    return only(datagrams(side.send(now, numbered(number))))


# What came after it tells.


def test_held_back_envelope_is_refused_once_others_came_two_seconds_ago(pair: Pair) -> None:
    """Within 2 s it is delivered: a radio may reorder. From two seconds and two steps on it is delayed."""
    in_time, *held = [frame(pair.a, 1.0, number) for number in range(3)]
    talk(pair, 1.0, 0.99 + c.LATE_AFTER_S)
    assert payloads(pair.b.receive(in_time, 0.999 + c.LATE_AFTER_S)) == [numbered(0)]
    assert pair.b.peer.traffic.out_of_order == 1
    surely = 1.0 + c.LATE_AFTER_S + 2 * c.LATE_STEP_S
    talk(pair, 0.999 + c.LATE_AFTER_S, surely)
    assert reasons(pair.b.receive(held[0], surely)) == [DropReason.DELAYED]
    talk(pair, surely, 8.0)
    assert reasons(pair.b.receive(held[1], 8.0)) == [DropReason.DELAYED]
    assert pair.b.peer.traffic.drops == {DropReason.DELAYED: 2}
    assert pair.carries(8.0)


def test_copy_is_a_duplicate_for_two_seconds_and_a_late_copy_after_that(pair: Pair) -> None:
    """The window and the remembered counters tell it, whatever path it comes along. It is not delayed."""
    once = frame(pair.a, 1.0)
    assert payloads(pair.b.receive(once, 1.0)) == [numbered(0)]
    talk(pair, 1.0, 2.9)
    assert pair.b.receive(once, 2.9) == []
    assert pair.b.peer.traffic.drops == {DropReason.DUPLICATE: 1}
    talk(pair, 3.0, 8.0)
    assert pair.b.receive(once, 8.0) == []
    assert pair.b.peer.traffic.drops == {DropReason.DUPLICATE: 1, DropReason.LATE_COPY: 1}
    assert reasons(pair.b.receive(once, 8.0, ELSEWHERE)) == [DropReason.REPLAYED]


# After a silence the peer is asked.


def test_without_an_answer_what_is_held_is_given_up(pair: Pair) -> None:
    """Ten questions within a second, then it is dropped and counted; the next envelope begins again."""
    questions = datagrams(pair.b.receive(frame(pair.a, SILENT), SILENT))
    moments = []
    while (now := pair.b.node.next_deadline()) <= SILENT + c.HOLD_S:
        outputs = pair.b.timeout(now)
        questions += datagrams(outputs)
        moments.append(now)
    assert moments == pytest.approx([SILENT + number / 10 for number in range(1, 11)])
    assert len(questions) == 10
    assert of(outputs, Dropped) == [Dropped(DropReason.DOUBTFUL, pair.b.peer, None, 1)]
    # The answers come too late: old as they are they vouch for nothing.
    for question in questions:
        assert pair.b.receive(only(datagrams(pair.a.receive(question, SILENT))), SILENT + 1.95) == []
    assert len(datagrams(pair.b.receive(frame(pair.a, SILENT + 1.95, 7), SILENT + 1.95))) == 1
    assert reasons(pair.b.timeout(SILENT + 1.95 + c.HOLD_S)) == [DropReason.DOUBTFUL]
    assert pair.crosses(pair.a, pair.b, 40.0)


def test_answer_and_question_from_before_the_silence_vouch_for_nothing(pair: Pair) -> None:
    """An answer that was held back with the frames is as old as they are. A question kept from before is answered."""
    out = pair.b.receive(frame(pair.a, SILENT), SILENT)
    old_answer = only(datagrams(pair.a.receive(only(datagrams(out)), SILENT)))
    question = pair.a.envelope(SILENT, Probe(question=7, answer=0, sent=5, received=5).encode())
    pair.b.timeout(SILENT + 1.0)
    kept, later = frame(pair.a, SILENT + 1.0, 9), SILENT + 20.0
    (answer,) = (one for one in datagrams(pair.b.receive(question, later)) if len(one) == 5 + 20 + 16)
    assert probe_in(pair.a, answer).answer == 7
    assert payloads(pair.b.receive(kept, later)) == []
    assert payloads(pair.b.receive(old_answer, later)) == []
    assert reasons(pair.b.timeout(later + c.HOLD_S)) == [DropReason.DOUBTFUL]


def test_held_frames_can_be_popped_while_requests_continue(pair: Pair) -> None:
    """After a pause of this process the shell drops held frames. The core delivers the frames after the answer."""
    question = only(datagrams(pair.b.receive(frame(pair.a, SILENT, 1), SILENT)))
    assert payloads(pair.b.node.pop_held()) == [numbered(1)]
    assert pair.b.node.pop_held() == []
    answer = only(datagrams(pair.a.receive(question, SILENT + 0.1)))
    assert payloads(pair.b.receive(answer, SILENT + 0.2)) == []
    assert payloads(pair.b.receive(frame(pair.a, SILENT + 0.2, 2), SILENT + 0.3)) == [numbered(2)]


@pytest.mark.parametrize("ends_by", ["close", "removal", "age", "daemon"])
def test_held_frames_do_not_outlive_their_session(pair: Pair, ends_by: str) -> None:
    """Whatever ends the session, what was held is counted and never delivered."""
    now = c.REJECT_AFTER_S - 0.1
    question = only(datagrams(pair.b.receive(frame(pair.a, now), now)))
    answer = only(datagrams(pair.a.receive(question, now)))
    peer = pair.b.peer
    match ends_by:
        case "close":
            outputs = pair.b.receive(pair.a.envelope(now, wire.Close().encode()), now)
        case "removal":
            outputs = pair.b.node.remove_peer(pair.b.peer, now)
        case "age":
            outputs = pair.b.timeout(c.REJECT_AFTER_S)
        case _:
            outputs = pair.b.node.close(now)
    assert of(outputs, Dropped) == [Dropped(DropReason.DOUBTFUL, peer, None, 1)]
    assert peer.traffic.drops == {DropReason.DOUBTFUL: 1}
    assert payloads(pair.b.receive(answer, now)) == []


def test_kept_envelopes_keep_no_link_up() -> None:
    """Kept envelopes that are let through one by one do not hide that the link is lost; an answer brings it back."""
    pair = Pair(link_a=quiet(), link_b=lively(keepalive_s=1e6)).establish()
    kept = [frame(pair.a, 0.5, number) for number in range(8)]
    pair.b.send(3.0)
    lost_at = 0.0
    for number, envelope in enumerate(kept):
        now = 3.0 + number / 2
        outputs = pair.b.receive(envelope, now) + pair.b.timeout(now)
        assert payloads(outputs) == []
        if of(outputs, PeerLost):
            lost_at = now
    assert 3.0 + c.LOST_AFTER_S <= lost_at <= 3.5 + c.LOST_AFTER_S
    now = 10.0
    pair.b.timeout(now)
    question = only(datagrams(pair.b.receive(frame(pair.a, now, 9), now), wire.SHORT_ENVELOPE))
    assert not pair.b.peer.is_up
    outputs = pair.b.receive(only(datagrams(pair.a.receive(question, now))), now)
    assert of(outputs, PeerUp) == [PeerUp(pair.b.peer)]
    assert payloads(outputs) == [numbered(9)]


# What is counted.


def test_missing_envelopes_are_those_that_can_come_no_more(pair: Pair) -> None:
    """What is overtaken is not missing; what did not come in two seconds is, and stays so over sessions."""
    overtaken = frame(pair.a, 1.0)
    for number in range(30):
        now = 1.0 + number / 10
        envelope = frame(pair.a, now, number)
        if number not in (3, 4):
            pair.b.receive(envelope, now)
        if number == 15:
            pair.b.receive(overtaken, now)
    peer = pair.b.peer
    # It has asked along its path: whether it has others is not known at 4.0 yet.
    assert [peer.missing(at) for at in (3.0, 4.0, 12.0, 60.0)] == [0, 0, 2, 2]
    frame(pair.a, 4.0)  # lost
    pair.crosses(pair.a, pair.b, 4.0)
    pair.b.receive(pair.a.envelope(4.0, wire.Close().encode()), 4.0)
    assert peer.missing(60.0) == 3
    assert peer.traffic.out_of_order == 1


# Sessions.


def rekeyed(now: float, *, received: bool = True) -> tuple[Pair, bytes]:
    """A pair with a second session since ``now``, and an envelope that alpha sent on the first before."""
    pair = Pair(link_a=quiet(), link_b=quiet()).establish()
    if received:
        assert pair.carries(now - 0.5)
    old = frame(pair.a, now - 0.5, 5)
    pair.rekey(now)
    assert len(pair.b.peer.sessions.confirmed) == 2
    return pair, old


def test_late_frame_of_the_session_before_is_asked_about_on_it() -> None:
    """The request goes on the unverified session. The answer reports on that session, whichever carries it."""
    pair, old = rekeyed(10.0, received=False)
    outputs = pair.b.receive(old, 10.1)
    assert payloads(outputs) == []
    question = only(datagrams(outputs))
    assert question[1:3] == pair.b.peer.sessions.confirmed[1].remote_index.to_bytes(2)
    answer = only(datagrams(pair.a.receive(question, 10.1)))
    assert answer[1:3] == pair.b.session.local_index.to_bytes(2)
    payload = unsealed(pair.b.session, answer)
    assert payload is not None
    echo = wire.parse_control(payload)
    assert isinstance(echo, wire.Echo)
    assert echo.fresh == pair.a.peer.sessions.confirmed[1].fresh(10.1)
    assert payloads(pair.b.receive(answer, 10.2)) == [numbered(5)]


def test_overtaken_by_the_next_session_frames_have_two_seconds() -> None:
    """Reordered over a change of keys nothing is lost: it is from the peer's first envelope on the new session on."""
    for late_s, comes in ((c.LATE_AFTER_S - 0.001, True), (c.LATE_AFTER_S, False)):
        pair, old = rekeyed(10.0)
        last = pair.a.peer.sessions.confirmed[1].seal(numbered(6), 9.9)
        assert payloads(pair.b.receive(old, 11.0)) == [numbered(5)]
        outputs = pair.b.receive(last, 10.0 + late_s)
        assert (payloads(outputs) == [numbered(6)]) == comes
        assert (reasons(outputs) == [DropReason.DELAYED]) != comes
        assert pair.b.peer.missing(60.0) == 0


def test_late_control_records_of_the_previous_session_do_not_keep_the_peer_up(pair: Pair) -> None:
    """The Node acts on them, but an attacker that delays them cannot keep a lost peer up."""
    assert pair.carries(9.5)
    kept = [pair.a.envelope(9.9, b"") for _ in range(8)]
    question = pair.a.envelope(9.9, wire.Echo(False, 7, 0, 0).encode())
    pair.rekey(10.0)
    for number, envelope in enumerate(kept):
        pair.b.receive(envelope, 10.5 + number)
    assert pair.b.peer.received_at == 11.5
    assert len(datagrams(pair.b.receive(question, 20.0))) == 1
    assert pair.b.peer.received_at == 11.5


def test_frames_on_a_session_that_ends_as_it_is_confirmed_are_counted() -> None:
    """Four newer ones came before the late confirmation of the first: what it carries can be asked about nowhere."""
    pair = Pair(link_a=quiet(), link_b=quiet())
    initiator, waiting = pair.a.peer.initiator, []
    for _ in range(c.USABLE_PER_PEER + 1):
        initiation = only(datagrams(establish.initiate(pair.a.peer, 0.0)))
        waiting.append(wire.parse_response(only(datagrams(pair.b.receive(initiation, 0.0)))))
    sessions = []
    for response in waiting:
        index = response.receiver_index
        keys = initiator.receive_response(initiator.pending[index], response)
        sessions.append(Session(keys, index, 0.0, 180.0, is_initiator=True))
    for number, session in enumerate(sessions[1:]):
        pair.b.peer.sessions.unconfirmed[session.remote_index].session.created_at = float(number + 1)
        pair.b.receive(session.seal(b"", 1.0), 1.0)
    outputs = pair.b.receive(sessions[0].seal(FRAME, 2.5), 2.5)
    assert reasons(outputs) == [DropReason.DOUBTFUL]
    assert payloads(outputs) == []
