"""Envelopes from a peer."""

from __future__ import annotations

from uavlinkd.core import constants as c
from uavlinkd.core import freshness, wire
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.establish import adopt, receive_close
from uavlinkd.core.outputs import Deliver, Output, PathChanged
from uavlinkd.core.path import Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.refusals import RefusalReport
from uavlinkd.core.send import challenge, seal
from uavlinkd.core.session import Session

_CHALLENGE = bytes((wire.PATH_CHALLENGE,))  # it is answered: with an own challenge more bytes would go back than came


def receive_envelope(
    peer: Peer, session: Session, datagram: bytes, header_bytes: int, counter: int, path: Path, now: float
) -> list[Output]:
    """Open an envelope and act on it.

    Raises:
        Drop: as :meth:`Session.open`; then nothing was changed.
    """
    payload = session.open(datagram, header_bytes, counter, now)
    out: list[Output] = []
    sessions, traffic = peer.sessions, peer.traffic
    traffic.envelopes_received += 1
    traffic.bytes_received += len(datagram)
    if session.local_index in sessions.unconfirmed:
        out += adopt(peer, session, sessions.unconfirmed[session.local_index].path, now)

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

    if counter != session.window.highest:
        traffic.out_of_order += 1
    elif path != peer.path and session is sessions.current and payload[:1] != _CHALLENGE:
        out += challenge(peer, session, path, len(datagram), now)

    if not payload:
        return out
    if payload[0] < wire.FRAMES_FROM:
        out += _receive_control(peer, session, payload, path, now, is_new=is_new)
    elif is_superseded:
        out += peer.drop(DropReason.DELAYED, 1)
    elif not is_new:
        out += freshness.hold(peer, session, counter, payload, now)
    elif now < session.verification.look_at:
        out.append(Deliver(peer, payload))
    else:
        out += freshness.deliver(peer, session, counter, payload, now)
    return out


def _receive_control(
    peer: Peer, session: Session, payload: bytes, path: Path, now: float, *, is_new: bool
) -> list[Output]:
    try:
        control = wire.parse_control(payload)
    except Drop as drop:
        return [peer.drop_datagram(drop.reason, path)]
    match control:
        case wire.Echo() as echo:
            return _receive_echo(peer, session, echo, now)
        case wire.PathChallenge(token):
            # Back along the path that it came by: that is what it asks. The response is not longer.
            return seal(peer, session, wire.PathResponse(token).encode(), path, now, is_answer=True)
        case wire.PathResponse(token):
            return _receive_path_response(peer, token, path, now)
        case wire.Close():
            return receive_close(peer, session, now)
        case RefusalReport():  # pragma: no branch  # the last kind there is
            if not session.parameters.features & c.FEATURE_REFUSALS:
                return [peer.drop_datagram(DropReason.BAD_CONTROL, path)]
            if is_new:  # older totals must not replace newer ones, nor look like a change of now
                peer.refusal_claims.note(control, now)
            return []


def _receive_echo(peer: Peer, session: Session, echo: wire.Echo, now: float) -> list[Output]:
    # A report of more than was sent, or than was expected, is a lie.
    if echo.received <= echo.expected <= session.send_counter:
        if session is peer.sessions.current:
            peer.traffic.reported = (echo.expected, echo.received)
        if echo.expected > session.fresh(now, c.HOLD_S):
            session.verification.extend(now)
    if echo.is_reply:
        return freshness.receive_answer(peer, echo, now)
    assert peer.path is not None, "a session came along a path"
    # On the session that sends, whichever session the request came on: otherwise a peer that never had our newest
    # session would go on receiving on an older one, and never initiate for what it misses.
    current = peer.sessions.current or session
    reply = wire.Echo(True, echo.token, current.received, current.expected, session.fresh(now))
    return seal(peer, current, reply.encode(), peer.path, now, is_answer=True)


def _receive_path_response(peer: Peer, token: bytes, path: Path, now: float) -> list[Output]:
    if not peer.challenger.receive_response(token, path, now):
        return [peer.drop_datagram(DropReason.BAD_PATH_RESPONSE, path)]
    if path == peer.path:  # a handshake has moved the traffic already
        return []
    peer.path = path
    return [PathChanged(peer, path)]
