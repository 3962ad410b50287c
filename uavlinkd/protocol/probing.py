"""Probes along the paths to a peer, and what their answers change. README.md, section 15."""

from __future__ import annotations

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.counters import Arrivals
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.early import EarlyFrames
from uavlinkd.protocol.outputs import Output
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.send import resend, send_payloads
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.sessions import Unconfirmed
from uavlinkd.protocol.wire import ANSWER_BYTES, MACS_BYTES, QUESTION_BYTES, Probe


def update(peer: Peer, now: float) -> list[Output]:
    """Judge the paths, and set when to do so again."""
    out: list[Output] = [*peer.paths.update(peer, now)]
    peer.set_paths_timer()
    follow_paths(peer, now)
    return out


def follow_paths(peer: Peer, now: float) -> None:
    """The paths have changed, or there is another session: set how long to wait for answers, and how often to ask.

    Every session of a peer with several paths, or one along a relay, notes its arrivals: copies may overtake the
    envelopes of each, and a new handle carries recent ones again.
    """
    peer.set_waits()
    pace, has_copies = peer.paths.pace, peer.paths.has_several or peer.paths.has_relayed
    if has_copies and peer.early is None:
        peer.early = EarlyFrames(peer.paths)
    for session in peer.sessions.confirmed:
        session.set_pace(pace, peer.verify_interval_s, now)
        if has_copies and session.arrivals is None:
            session.arrivals = Arrivals(now)


def ask_everywhere(peer: Peer, session: Session, now: float, waiting: Unconfirmed | None = None) -> list[Output]:
    """A session begins: ask along every path, also those that carried its handshake (``waiting``)."""
    paths = peer.paths
    if waiting is not None:
        for path in waiting.paths[: c.LEARNED_PATHS]:
            if paths.find(path) is None:
                state = learn(peer, path, now)
                state.bytes_received, state.bytes_sent = waiting.initiation_bytes, len(waiting.response) + MACS_BYTES
    out: list[Output] = []
    for state in paths.states:
        if state.is_configured and not paths.has_several:
            break  # the echo requests of the session ask the same
        is_wanted = not state.is_metered or state is paths.best or peer.settings.link.idle_probe_s > 0
        if is_wanted and not state.is_off:
            out += ask(peer, session, state, now)
    return out + update(peer, now)


def ask(peer: Peer, session: Session, state: PathState, now: float) -> list[Output]:
    """Send a question along a path, if that may get so many bytes."""
    if not state.allows(session.envelope_bytes(QUESTION_BYTES)):
        return []
    return _send(peer, session, state, peer.new_question(), 0, now)


def wants_question(state: PathState, now: float, least_s: float = 0.0) -> bool:
    """Whether to ask along a path because an envelope came along it: it does not work here, and may now.

    ``least_s``: between questions that are datagrams of their own, if the network has a budget. The first question
    to a learned path may have been longer than what had come from there. It is sent when more comes.
    """
    is_due = not state.datagrams_sent or now >= state.questioned_at + max(c.PROBE_FAST_S, least_s)
    return is_due and not state.works


def ask_candidates(peer: Peer, now: float) -> list[Output]:
    """Send a question to each candidate, as far as the peer's bucket allows. README.md, section 22."""
    session = peer.sending_session()
    if session is None or not peer.is_up:
        return []
    out: list[Output] = []
    for state in peer.paths.to_ask(now):
        if not peer.candidate_questions.take(now):
            break
        session.uncounted += 1
        out += _send(peer, session, state, peer.new_question(), 0, now)
    if out:
        peer.paths.searched_at = now
        out += handle_timeout(peer, now)  # the peer must learn that the paths lost none of them
    return out


def learn(peer: Peer, path: Path, now: float) -> PathState:
    """An envelope that is not a copy came from an unknown address: it may be the peer's."""
    state = peer.paths.learn(path, now)
    follow_paths(peer, now)
    return state


def receive_probe(
    peer: Peer, session: Session, probe: Probe, state: PathState, now: float, *, is_copy: bool = False
) -> list[Output]:
    """Note the report, take the answer, and answer the question along the path that it came by.

    ``is_copy``: it arrived along another path before, because a sender that is faster than the peer copied it. That
    sender could keep every question along the peer's own path from being answered, so a question is answered once
    along each path. The counts belong to one path, and it is unknown which: they are ignored.
    """
    out: list[Output] = []
    counts = session is peer.sessions.current and not is_copy
    if counts:
        lost, age_s = state.receive_report(probe, now), now - session.created_at
        peer.losses.note_report(lost, now, age_s, asks=probe.question != 0)
    if probe.answer:
        is_first = not state.is_validated
        round_trip_s = state.receive_answer(probe.answer, probe.received if counts else None, now)
        if round_trip_s is not None:
            peer.handshake_s = 0.0
            if peer.round_trip_s is None or not peer.paths.has_several:
                peer.round_trip_s = round_trip_s
            peer.paths.note_answer(state, now)
            if is_first and state.path.is_relayed:
                out += resend(peer, state, now)
        elif not is_copy:
            out.append(peer.drop_datagram(DropReason.UNEXPECTED_ANSWER, state.path))
    if probe.question and not (is_copy and probe.question == state.copied_question):
        if is_copy:
            state.copied_question = probe.question
        # A path that does not work here carried a question: it is asked in the answer, if it may get the bytes.
        asks = not is_copy and wants_question(state, now) and state.allows(session.envelope_bytes(QUESTION_BYTES))
        if asks or state.allows(session.envelope_bytes(ANSWER_BYTES)):
            out += _send(peer, session, state, peer.new_question() if asks else 0, probe.question, now)
    return out + update(peer, now)


def handle_timeout(peer: Peer, now: float) -> list[Output]:
    """Judge the paths and send the questions that are due."""
    out = update(peer, now)
    session = peer.sending_session()
    if session is None or not peer.is_up:
        return out
    for state in peer.paths.states:
        if now >= state.question_at:
            out += ask(peer, session, state, now)
            state.questioned_at = now  # also if nothing could be sent
        if now >= peer.paths.test_at(state):
            out += _test_limit(peer, session, state, now)
    peer.paths.schedule(now)
    peer.set_paths_timer()
    return out


def _test_limit(peer: Peer, session: Session, state: PathState, now: float) -> list[Output]:
    """Test how long envelopes may be: if a short probe beside the padded one is answered alone, that was too long."""
    longest = min(session.max_envelope, peer.paths.network_limit(state))
    size = state.envelope_limit.next_size(longest, state.answered_at, state.wait_s, now)
    out: list[Output] = []
    for length in (size, 0) if size else ():
        record = state.make_test(peer.new_question(), length, now)
        padding = max(0, length - session.envelope_bytes(QUESTION_BYTES))
        out += send_payloads(peer, session, (record.encode(padding=padding),), (state,), now, is_answer=True)
        if length:
            session.uncounted += 1
            state.sent -= 1
    return out


def _send(peer: Peer, session: Session, state: PathState, question: int, answer: int, now: float) -> list[Output]:
    record = state.make_probe(question, answer, now)
    # Along one path, so its silence says nothing about the peer: it starts no count of silence.
    return send_payloads(peer, session, (record.encode(),), (state,), now, is_answer=True)
