"""How old what a peer sends may be: which frames are delivered, which are held, and when the peer is asked.

README.md, section 11.
"""

from __future__ import annotations

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Deliver, Output
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.send import ask_for_echo
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.wire import Report


def deliver(peer: Peer, session: Session, counter: int, payload: bytes, now: float) -> list[Output]:
    """Deliver frames that follow others. Ask for an echo if one is due. Hold what must be new, if unverified."""
    out: list[Output] = []
    verification = session.verification
    if now >= verification.ask_at and peer.sessions.is_in_use(session):
        verification.due_at = -c.NEVER  # repeat the request until it is answered
        out += ask_for_echo(peer, session, now, peer.paths.echo_route)
    if now <= verification.until:
        return [*out, Deliver(peer, payload, session.order_of(counter))]
    if peer.unverified_since is None and now > verification.until + session.held.pace.hold_s:
        peer.unverified_since = now
    passing, waiting = peer.screen(payload)
    if passing:
        out.append(Deliver(peer, passing, session.order_of(counter)))
    if waiting:
        out += hold(peer, session, counter, waiting, now)
    return out


def hold(peer: Peer, session: Session, counter: int, payload: bytes, now: float) -> list[Output]:
    """Hold frames until the peer has reported whether they are new."""
    pushed_out = session.held.add(counter, payload, now)
    return peer.drop(DropReason.DOUBTFUL, pushed_out) + question(peer, session, now)


def question(peer: Peer, session: Session, now: float) -> list[Output]:
    """Something came that may be old: ask the peer, unless the daemon asks already."""
    if session not in peer.sessions.confirmed:  # it ended as soon as it was confirmed
        return _drop_held(peer, session)
    return ask_for_echo(peer, session, now) if session.held.begin(now) else []


def receive_report(
    peer: Peer, session: Session, counter: int, report: Report, now: float, *, is_new: bool
) -> list[Output]:
    """Note a report. After a silence it waits for proof: an older one must not replace a newer one, nor look new."""
    if is_new:
        peer.claims.note(report, now)
        return []
    waiting = session.unverified_reports.get(type(report))
    if waiting is None or waiting[0] < counter:
        session.unverified_reports[type(report)] = counter, report
    return question(peer, session, now)


def receive_answer(peer: Peer, echo: wire.Echo, now: float) -> list[Output]:
    """The peer tells which counters are new, on the session of the request."""
    peer.traffic.echoes_unanswered += peer.echo_requests.expire(now)
    if peer.echo_requests.is_late(echo.token):
        _refute(peer)
    request = peer.echo_requests.answer(echo.token)
    if request is None:
        return []
    peer.round_trip_s = now - request.sent_at
    peer.paths.note_echo(peer.round_trip_s, now)
    peer.handshake_s = 0.0
    peer.set_waits()
    peer.set_paths_timer()
    session = request.session
    if session is None:
        return []
    session.refuse_below(echo.fresh)
    session.verification.answered(request.sent_at, now)
    peer.unverified_since = None
    out: list[Output] = []
    if peer.round_trip_s <= session.held.pace.hold_s:
        session.trusted_until = now + c.LATE_AFTER_S
        out += peer.note_received(now)
        for counter, report in session.unverified_reports.values():
            if counter >= echo.fresh:
                peer.claims.note(report, now)
        session.unverified_reports.clear()
        new, late = session.held.release(echo.fresh)
        out += [Deliver(peer, payload, session.order_of(counter)) for counter, payload in new]
        if peer.early is not None:
            peer.traffic.out_of_order += sum(peer.early.note(session.order_base + counter) for counter, _ in new)
        out += peer.drop(DropReason.DELAYED, late)
    return out


def handle_timeout(peer: Peer, now: float) -> list[Output]:
    """On each session: ask again, and drop what was held for too long."""
    out: list[Output] = []
    if peer.early is not None:
        out += peer.early.release(now)
    for session in peer.sessions.confirmed:
        held, verification = session.held, session.verification
        if now >= held.due_at:
            out += peer.drop(DropReason.DOUBTFUL, held.expire(now))
            if held.is_request_due(now):
                out += ask_for_echo(peer, session, now)
        if now >= verification.due_at:
            if now > session.trusted_until:  # no frames arrive: the next one is asked about
                verification.due_at = c.NEVER
            else:
                out += ask_for_echo(peer, session, now)
    peer.set_freshness()
    return out


def end(peer: Peer, sessions: list[Session]) -> list[Output]:
    """What ends with sessions: frames that were held, requests about them, and the count of missing envelopes."""
    out: list[Output] = []
    if sessions:
        peer.paths.outlet = None  # it has a session with its keys
    for session in sessions:
        out += _drop_held(peer, session)
        peer.echo_requests.forget(session)
        peer.traffic.missing += session.missing(c.NEVER)
        peer.traffic.sealed += session.send_counter
        peer.traffic.opened += session.received
    return out


def _refute(peer: Peer) -> None:
    """An answer came late: so slow a path, or an attacker that stretches time. Nothing is known to be new."""
    peer.echo_requests.was_late = True
    for session in peer.sessions.confirmed:
        session.trusted_until = -c.NEVER
        session.verification.refute()


def _drop_held(peer: Peer, session: Session) -> list[Output]:
    _, held = session.held.release(c.SESSION_ENVELOPE_LIMIT)
    return peer.drop(DropReason.DOUBTFUL, held)
