"""Envelopes from a peer."""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

from uavlinkd.core import constants as c
from uavlinkd.core import freshness, probing, wire
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.early import EarlyEnvelope
from uavlinkd.core.establish import adopt, receive_close
from uavlinkd.core.outputs import Deliver, Output, RecordReceived
from uavlinkd.core.path import Path
from uavlinkd.core.path_state import PathCondition, PathState
from uavlinkd.core.paths import Route
from uavlinkd.core.peer import Peer
from uavlinkd.core.probe import ANSWER_BYTES, PROBE, QUESTION_BYTES
from uavlinkd.core.problem_reports import ProblemReport
from uavlinkd.core.refusals import RefusalReport
from uavlinkd.core.relay_records import FleetRecord, parse_record
from uavlinkd.core.send import may_echo, send_echo
from uavlinkd.core.session import Session
from uavlinkd.core.timers import Timer

_PROBE = bytes((PROBE,))
_ANSWERED_BYTES = ANSWER_BYTES, QUESTION_BYTES, wire.ECHO_REQUEST_BYTES
"""Payloads of these lengths may want an answer along each path by which they come."""


class Arrived(NamedTuple):
    """An authentic control record: where and when it arrived."""

    peer: Peer
    session: Session
    counter: int
    state: PathState
    now: float
    is_new: bool
    """Whether its envelope is known to be new."""
    is_superseded: bool
    """Whether the peer has been sending on newer keys for a while."""


def receive_envelope(
    peer: Peer, session: Session, datagram: bytes, header: tuple[int, int, int], path: Path, now: float
) -> list[Output]:
    """Open an envelope and act on it. ``header``: as :func:`wire.parse_envelope_header` returns it.

    Raises Drop: as :meth:`Session.open`, or ``REPLAYED``; then nothing was changed.
    """
    _, counter, header_bytes = header
    payload = session.open(datagram, header_bytes, counter, now)
    out: list[Output] = []
    sessions, traffic = peer.sessions, peer.traffic
    state, size = peer.paths.by_path.get(path), len(datagram)
    if payload is None:
        return _receive_copy(peer, session, datagram, header, path, now)
    traffic.envelopes_received += 1
    traffic.bytes_received += size
    if session.local_index in sessions.unconfirmed:
        waiting = sessions.unconfirmed[session.local_index]
        out += adopt(peer, session, path, now, waiting.certificate)
        if session is sessions.current:
            out += probing.ask_everywhere(peer, session, now, waiting)
        state = peer.paths.find(path)
    is_candidate = state is None
    if state is None:
        state = probing.learn(peer, path, now)
    state.datagrams_received += 1
    state.bytes_received += size
    state.received_at = now
    if session is sessions.current:
        state.received += 1
    if session.arrivals is not None:
        session.arrivals.note(counter, state.number, now)

    is_superseded = session is not sessions.current and sessions.is_superseded(session, now)
    is_new = now <= session.trusted_until and not is_superseded
    if is_new:
        session.trusted_until = now + c.LATE_AFTER_S
        peer.received_at = now
        peer.unanswered_since = None
        if not peer.is_up:
            out += peer.note_received(now)
    elif not peer.is_up and not is_superseded:
        out += freshness.question(peer, session, now)

    if state.condition is not PathCondition.USABLE and payload[:1] != _PROBE:
        is_asked = peer.paths.has_several or not state.is_configured  # else by echo requests
        least_s = peer.paths.facts.least_probe_s(path)
        if is_asked and session is sessions.current and probing.wants_question(state, now, least_s):
            out += probing.ask(peer, session, state, now)
        if is_candidate:
            out += probing.update(peer, now)
    if not payload:
        return out
    is_along_best = payload[0] < wire.FRAMES_FROM  # if frames follow: a probe is in front of them
    if is_along_best:
        arrived = Arrived(peer, session, counter, state, now, is_new, is_superseded)
        controlled, payload = _receive_control(arrived, payload)
        out += controlled
        if not payload:
            return out
    early = peer.early
    traffic.out_of_order += (
        counter < session.window.highest if early is None else session.order_base + counter < early.highest
    )
    if is_superseded:
        out += peer.drop(DropReason.DELAYED, 1)
    elif not is_new:
        out += freshness.hold(peer, session, counter, payload, now)
    else:
        order = 0 if session.arrivals is None else session.order_of(counter)  # without a call for one path
        delivered: list[Output] = [Deliver(peer, payload, order)]
        if now >= session.verification.look_at:
            delivered = freshness.deliver(peer, session, counter, payload, now)
        if early is not None:
            out += [output for output in delivered if not isinstance(output, Deliver)]
            frames = [output for output in delivered if isinstance(output, Deliver)]
            envelope = EarlyEnvelope(session.order_base + counter, session, state, frames, is_along_best)
            delivered = early.arrive(envelope, now)
            if early.due_at < peer.timers.deadlines[Timer.FRESHNESS]:
                peer.timers.set(Timer.FRESHNESS, early.due_at)
        out += delivered
    return out


def _receive_copy(
    peer: Peer, session: Session, datagram: bytes, header: tuple[int, int, int], path: Path, now: float
) -> list[Output]:
    """Count an authentic envelope that was accepted before. Of a recent one, learn how much later its path is.

    A recent probe still asks and answers along this path: see :func:`probing.receive_probe`. Raises ``REPLAYED``.
    """
    out: list[Output] = []
    _, counter, header_bytes = header
    is_recent = not session.is_late(counter, now)
    state = peer.paths.find(path)
    if not is_recent and (state is None or not state.is_validated):
        raise Drop(DropReason.REPLAYED)
    if state is not None:
        state.datagrams_received += 1
        state.bytes_received += len(datagram)
        state.duplicates += 1
        if session.arrivals is not None:
            is_known = counter > session.window.highest - c.ARRIVALS
            number, lag_s = session.arrivals.first(counter, now) if is_known else (0, 0.0)
            # Twice along one path: the peer, the network or an attacker repeats it. It hides no loss. Of an
            # older one this end cannot tell, so such a copy does not count either.
            if is_known and session.arrivals.note_copy(counter, state.number):
                if session is peer.sessions.current:
                    state.received += 1
                    first = peer.paths.with_number(number)
                    if is_recent and first is not None:
                        first.copy_lag_s, state.copy_lag_s = 0.0, lag_s
                if is_recent and len(datagram) - header_bytes - session.tag_bytes in _ANSWERED_BYTES:
                    out = _answer_copy(peer, session, session.reopen(datagram, header_bytes, counter), state, now)
    peer.traffic.drops[DropReason.DUPLICATE if is_recent else DropReason.LATE_COPY] += 1
    return out


def _answer_copy(peer: Peer, session: Session, payload: bytes, state: PathState, now: float) -> list[Output]:
    """Answer a request or a probe along each path by which it comes: the others may not carry the answer."""
    with suppress(Drop):  # it holds frames, or was dropped when it came first
        match wire.parse_control(payload):
            case wire.ProbeAndFrames(probe):
                return probing.receive_probe(peer, session, probe, state, now, is_copy=True)
            case wire.Echo(is_reply=False) as request if may_echo(peer, state, now, is_reply=True):
                return _reply(peer, session, request, (state,), now)
    return []


def _receive_control(arrived: Arrived, payload: bytes) -> tuple[list[Output], bytes]:
    """Act on a control record. Returns the frames behind it too."""
    peer, session, state, now = arrived.peer, arrived.session, arrived.state, arrived.now
    try:
        control = wire.parse_control(payload)
    except Drop as drop:
        return [peer.drop_datagram(drop.reason, state.path)], b""
    match control:
        case wire.Echo() as echo:
            return _receive_echo(peer, session, echo, state, now), b""
        case wire.ProbeAndFrames(probe, frames):
            return probing.receive_probe(peer, session, probe, state, now), frames
        case wire.Close():
            return receive_close(peer, session, now), b""
        case wire.SealedRecord(sealed):
            return _receive_record(arrived, sealed), b""
        case RefusalReport() | ProblemReport():  # pragma: no branch  # the last kinds there are
            feature = c.FEATURE_REFUSALS if isinstance(control, RefusalReport) else c.FEATURE_PROBLEMS
            if not session.parameters.features & feature:
                return [peer.drop_datagram(DropReason.BAD_CONTROL, state.path)], b""
            if arrived.is_superseded:
                return [], b""
            out = freshness.receive_report(peer, session, arrived.counter, control, now, is_new=arrived.is_new)
            return out, b""


def _receive_record(arrived: Arrived, sealed: bytes) -> list[Output]:
    peer, session, path = arrived.peer, arrived.session, arrived.state.path
    try:
        opened = parse_record(session.open_record(arrived.counter, sealed))
    except Drop as drop:
        return [peer.drop_datagram(drop.reason, path)]
    if isinstance(opened, FleetRecord) and not session.parameters.features & c.FEATURE_FLEET:
        return [peer.drop_datagram(DropReason.BAD_CONTROL, path)]
    if arrived.is_superseded:
        return [peer.drop_datagram(DropReason.OLD_RECORD, path)]
    return [RecordReceived(peer, path, opened, session.order_base + arrived.counter)]


def _receive_echo(peer: Peer, session: Session, echo: wire.Echo, state: PathState, now: float) -> list[Output]:
    # A report of more than was sent, or than was expected, is a lie.
    if echo.received <= echo.expected <= session.send_counter:
        if session is peer.sessions.current:
            peer.traffic.reported = (echo.expected, echo.received)
            request = peer.echo_requests.find(echo.token) if echo.is_reply else None
            if request is not None and request.session is session:
                peer.paths.note_echo_counts(request.sent_at, request.sent, request.repeats, echo.received)
        if echo.expected > session.fresh(now, session.held.pace.hold_s):
            session.verification.extend(now)
    if echo.is_reply:
        return freshness.receive_answer(peer, echo, now)
    route = peer.paths.echo_route
    return _reply(peer, session, echo, route if state in route else (*route, state), now)


def _reply(peer: Peer, session: Session, request: wire.Echo, route: Route, now: float) -> list[Output]:
    # On the session that sends, whichever session the request came on: otherwise a peer that never had our newest
    # session would go on receiving on an older one, and never initiate for what it misses.
    current = peer.sessions.current or session
    reply = wire.Echo(True, request.token, current.received, current.expected, session.fresh(now))
    return send_echo(peer, current, reply, route, now)
