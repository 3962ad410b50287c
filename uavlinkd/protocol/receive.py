"""The datagrams of peers: what a frame passes, and what is done about everything else in an envelope."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from typing import Final, NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import freshness, probing, wire
from uavlinkd.protocol.admission import CookieRequired
from uavlinkd.protocol.constants import LATE_AFTER_S
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.early import EarlyEnvelope
from uavlinkd.protocol.establish import adopt, receive_close, receive_hint
from uavlinkd.protocol.initiator import Pending
from uavlinkd.protocol.outputs import Deliver, Dropped, Output, RecordReceived, new_tuple
from uavlinkd.protocol.path import Path, SocketAddress, SocketFacts
from uavlinkd.protocol.path_slots import Route
from uavlinkd.protocol.path_state import PathCondition, PathState
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.receive_handshake import HandshakeReceiver
from uavlinkd.protocol.relay_records import FleetRecord, parse_record
from uavlinkd.protocol.send import may_echo, send_echo
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.sessions import Indices
from uavlinkd.protocol.timers import Schedule, Timer
from uavlinkd.protocol.wire import (
    ANSWER_BYTES,
    FRAMES_FROM,
    PROBE,
    QUESTION_BYTES,
    SHORT_ENVELOPE,
    SHORT_HEADER_BYTES,
    ProblemReport,
    RefusalReport,
)

USABLE: Final = PathCondition.USABLE
"""A name of the module: the class of an enumeration looks its members up by a Python function."""
_unpack_short = wire.SHORT_HEADER.unpack_from
_SHORT_LEAST: Final = wire.SHORT_HEADER_BYTES + wire.TAG_LENGTHS[0]
_NOBODY: Final = (None, None)
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


class DatagramReceiver:
    """What a node does about one datagram. :class:`uavlinkd.protocol.node.Node` has the peers, and sets these."""

    facts: SocketFacts
    """About the networks behind the sockets."""
    drops: Counter[DropReason]
    """Datagrams that name no peer; those that name one are counted there."""
    schedule: Schedule[Peer]
    """When each peer has something to do. Its ``next_at`` is :meth:`uavlinkd.protocol.node.Node.next_deadline`."""
    _indices: Indices[tuple[Peer, Session | Pending]]
    _handshakes: HandshakeReceiver
    _by_address: dict[SocketAddress, Peer]
    """Where peers are configured."""

    def receive(self, datagram: bytes, path: Path, now: float, *, is_screened: bool = False) -> list[Output]:
        """What to do about a datagram. Never raises, whatever the bytes.

        ``is_screened``: it passed the screen of handshake messages before it waited.
        """
        try:
            # The usual way of a frame from here on has no call but that which opens the envelope.
            size = len(datagram)
            if size >= _SHORT_LEAST and datagram[0] == SHORT_ENVELOPE:
                _, index, counter = _unpack_short(datagram)
                header_bytes = SHORT_HEADER_BYTES
            elif datagram[:1] in wire.ENVELOPE_STARTS:
                index, counter, header_bytes = wire.parse_envelope_header(datagram)
            else:
                if not is_screened:
                    self._handshakes.screen(datagram, path, now)
                return self._handshakes.receive(datagram, path, now)
            peer, session = self._indices.owners.get(index, _NOBODY)
            if peer is None or not isinstance(session, Session):
                return self._receive_stray(datagram, index, path, now)
            if self.facts.peer_at:
                self.facts.check_network(peer, path)
            payload = session.open(datagram, header_bytes, counter, now)
            if payload is None:
                copied = _receive_copy(peer, session, datagram, (index, counter, header_bytes), path, now)
                self.schedule.update(peer)
                return copied
            out: list[Output] = []
            sessions = peer.sessions
            last, state = peer.paths.inlet
            if last is not path:
                peer.paths.inlet = path, (state := peer.paths.by_path.get(path))
            is_candidate = False
            if state is None or sessions.unconfirmed:
                state, is_candidate = _settle(peer, session, path, now, out)
            state.datagrams_received += 1
            state.bytes_received += size
            state.received_at = now
            is_superseded = False
            if session is sessions.current:
                state.received += 1
            else:
                is_superseded = sessions.is_superseded(session, now)
            if session.arrivals is not None:
                session.arrivals.note(counter, state.number, now)
            is_new = now <= session.trusted_until and not is_superseded
            if is_new:
                session.trusted_until = now + LATE_AFTER_S
                peer.received_at = now
                peer.unanswered_since = None
                if not peer.is_up:
                    out += peer.note_received(now)
            elif not peer.is_up and not is_superseded:
                out += freshness.question(peer, session, now)
            if state.condition is not USABLE and payload[:1] != _PROBE:
                _ask_path(peer, session, state, now, out, is_candidate=is_candidate)
            if not payload:
                pass
            elif payload[0] >= FRAMES_FROM and is_new and peer.early is None and now < session.verification.look_at:
                if counter != session.window.highest:
                    peer.traffic.out_of_order += 1
                order = 0 if session.arrivals is None else session.order_base + counter
                out.append(new_tuple(Deliver, (peer, payload, order)))
            else:
                arrived = Arrived(peer, session, counter, state, now, is_new, is_superseded)
                _receive_other(arrived, payload, out)
            timers = peer.timers
            if timers.next_at < timers.scheduled_at:
                self.schedule.update(peer)
            return out
        except CookieRequired as drop:
            return [drop.reply, self._count(datagram, drop, path)]
        except Drop as drop:
            return [self._count(datagram, drop, path)]
        except Exception:
            if (claimed := self._claimed_peer(datagram)) is not None:
                self._wake(claimed, now)
            raise

    def _wake(self, peer: Peer, now: float) -> None:
        """A fault left the work for a peer half-done. All its timers expire soon: each finds what is due."""
        for timer, at in enumerate(peer.timers.deadlines):
            peer.timers.set(Timer(timer), min(at, now + c.RECOVER_S))
        self.schedule.update(peer)

    def _receive_stray(self, datagram: bytes, index: int, path: Path, now: float) -> list[Output]:
        """An envelope of no session."""
        wire.parse_envelope_header(datagram)  # may be malformed
        if self._indices.is_quarantined(index, now):
            raise Drop(DropReason.LATE)
        out: list[Output] = []
        if (peer := self._by_address.get(path.place)) is not None:
            out += receive_hint(peer, now)
            self.schedule.update(peer)
        return [*out, self._count(datagram, Drop(DropReason.UNKNOWN_INDEX), path)]

    def _count(self, datagram: bytes, drop: Drop, path: Path) -> Dropped:
        if (peer := self._claimed_peer(datagram)) is not None:
            return peer.drop_datagram(drop.reason, path, drop.detail)
        self.drops[drop.reason] += 1
        return Dropped(drop.reason, None, path, 1, drop.detail)

    def _claimed_peer(self, datagram: bytes) -> Peer | None:
        """The peer whose session or handshake the header names: a claim, good for a counter and no more."""
        index = wire.claimed_receiver_index(datagram)
        owner = self._indices.owners.get(index) if index else None
        return None if owner is None else owner[0]


def _settle(peer: Peer, session: Session, path: Path, now: float, out: list[Output]) -> tuple[PathState, bool]:
    """The slot of a path. Returns also whether it is new. The first envelope of a session confirms it."""
    sessions = peer.sessions
    if session.local_index in sessions.unconfirmed:
        waiting = sessions.unconfirmed[session.local_index]
        out += adopt(peer, session, path, now, waiting.certificate)
        if session is sessions.current:
            out += probing.ask_everywhere(peer, session, now, waiting)
    state = peer.paths.find(path)
    return (probing.learn(peer, path, now), True) if state is None else (state, False)


def _ask_path(
    peer: Peer, session: Session, state: PathState, now: float, out: list[Output], *, is_candidate: bool
) -> None:
    """Something came along a path that is not usable: ask along it, if that is due."""
    is_asked = peer.paths.has_several or not state.is_configured  # else by echo requests
    least_s = peer.paths.facts.least_probe_s(state.path)
    if is_asked and session is peer.sessions.current and probing.wants_question(state, now, least_s):
        out += probing.ask(peer, session, state, now)
    if is_candidate:
        out += probing.update(peer, now)


def _receive_other(arrived: Arrived, payload: bytes, out: list[Output]) -> None:
    """Act on the payload of an envelope that is not frames to be delivered at once."""
    if payload[0] < wire.FRAMES_FROM:
        _receive_control(arrived, payload, out)
    else:
        _receive_frames(arrived, payload, out, is_along_best=False)


def _receive_frames(arrived: Arrived, payload: bytes, out: list[Output], *, is_along_best: bool) -> None:
    """Deliver frames, hold them, or let them wait for others. ``is_along_best``: a probe was in front of them."""
    peer, session, counter, now = arrived.peer, arrived.session, arrived.counter, arrived.now
    early, traffic = peer.early, peer.traffic
    traffic.out_of_order += (
        counter < session.window.highest if early is None else session.order_base + counter < early.highest
    )
    if arrived.is_superseded:
        out += peer.drop(DropReason.DELAYED, 1)
    elif not arrived.is_new:
        out += freshness.hold(peer, session, counter, payload, now)
    else:
        delivered: list[Output] = [Deliver(peer, payload, session.order_of(counter))]
        if now >= session.verification.look_at:
            delivered = freshness.deliver(peer, session, counter, payload, now)
        if early is not None:
            out += [output for output in delivered if not isinstance(output, Deliver)]
            frames = [output for output in delivered if isinstance(output, Deliver)]
            envelope = EarlyEnvelope(session.order_base + counter, session, arrived.state, frames, is_along_best)
            delivered = early.arrive(envelope, now)
            if early.due_at < peer.timers.deadlines[Timer.FRESHNESS]:
                peer.timers.set(Timer.FRESHNESS, early.due_at)
        out += delivered


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


def _receive_control(arrived: Arrived, payload: bytes, out: list[Output]) -> None:
    """Act on a control record, and on the frames behind it."""
    peer, session, state, now = arrived.peer, arrived.session, arrived.state, arrived.now
    try:
        control = wire.parse_control(payload)
    except Drop as drop:
        out.append(peer.drop_datagram(drop.reason, state.path))
        return
    match control:
        case wire.Echo() as echo:
            out += _receive_echo(peer, session, echo, state, now)
        case wire.ProbeAndFrames(probe, frames):
            out += probing.receive_probe(peer, session, probe, state, now)
            if frames:
                _receive_frames(arrived, frames, out, is_along_best=True)
        case wire.Close():
            out += receive_close(peer, session, now)
        case wire.SealedRecord(sealed):
            out += _receive_record(arrived, sealed)
        case RefusalReport() | ProblemReport():  # pragma: no branch  # the last kinds there are
            feature = c.FEATURE_REFUSALS if isinstance(control, RefusalReport) else c.FEATURE_PROBLEMS
            if not session.parameters.features & feature:
                out.append(peer.drop_datagram(DropReason.BAD_CONTROL, state.path))
            elif not arrived.is_superseded:
                is_new = arrived.is_new
                out += freshness.receive_report(peer, session, arrived.counter, control, now, is_new=is_new)


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
