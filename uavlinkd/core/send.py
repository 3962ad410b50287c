"""What goes to a peer: frames and records in envelopes, and any datagram."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.constants import NEVER
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Output, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.refusals import Refused
from uavlinkd.core.session import Session
from uavlinkd.core.timers import Timer


def send_frames(peer: Peer, frames: Sequence[bytes], now: float) -> list[Output]:
    """Put frames that are here together into as few envelopes as hold them, in their order."""
    session, path = peer.sessions.current, peer.path
    if (
        session is None
        or path is None
        or now >= session.reject_at
        or session.send_counter >= c.SESSION_ENVELOPE_LIMIT
    ):
        return peer.drop(DropReason.NO_SESSION, len(frames))
    if peer.timers.deadlines[Timer.PROBE] == NEVER and peer.durations.probe_interval_s:
        peer.timers.set(Timer.PROBE, now + peer.durations.probe_interval_s)
    limit = session.payload_limit
    out: list[Output] = []
    batch: list[bytes] = []
    size = 0
    for frame in frames:
        if size + len(frame) > limit:
            if batch:
                out += seal(peer, session, b"".join(batch), path, now)
                batch, size = [], 0
            if len(frame) > limit:
                out += peer.drop(DropReason.TOO_LARGE, 1)
                continue
        batch.append(frame)
        size += len(frame)
    if batch:
        out += seal(peer, session, b"".join(batch), path, now)
    return out


def seal(
    peer: Peer, session: Session, payload: bytes, path: Path, now: float, *, is_answer: bool = False
) -> list[Output]:
    """Send an envelope. It expects an answer, unless it is one: two ends must not answer each other endlessly."""
    if session.send_counter >= c.SESSION_ENVELOPE_LIMIT:
        return peer.drop(DropReason.NO_SESSION, 1)
    datagram = session.seal(payload, now)
    peer.sent_at = now
    if peer.unanswered_since is None and not is_answer:
        peer.unanswered_since = now
        peer.echo_at = now + peer.durations.echo_after_s
        if now + peer.silence_s < peer.timers.deadlines[Timer.SILENCE]:
            peer.timers.set(Timer.SILENCE, now + peer.silence_s)
    if session.send_counter == c.REKEY_AFTER_ENVELOPES:
        peer.set_initiate()
    traffic = peer.traffic
    traffic.envelopes_sent += 1
    if path is not peer.path:
        return transmit(peer, datagram, path)
    traffic.datagrams_sent += 1
    traffic.bytes_sent += len(datagram)
    return [Transmit(datagram, path)]


def transmit(peer: Peer, datagram: bytes, path: Path) -> list[Output]:
    """Send a datagram. Only what goes where the peer may be counts towards the budget of its link."""
    if path in peer.candidates():
        peer.traffic.datagrams_sent += 1
        peer.traffic.bytes_sent += len(datagram)
    else:
        peer.traffic.bytes_elsewhere += len(datagram)
    return [Transmit(datagram, path)]


def report_refusals(peer: Peer, changed: Iterable[Refused], now: float) -> list[Output]:
    """Report what this end refuses of the peer's frames, if it has changed and the peer understands reports.

    A report expects no answer. ``changed``: the totals that changed since the last call.
    """
    peer.own_refusals.update(changed)
    session, path = peer.sessions.current, peer.path
    if session is None or path is None or not session.is_usable(now):
        return []
    if not session.parameters.features & c.FEATURE_REFUSALS:
        return []
    report = peer.own_refusals.take(now)
    return [] if report is None else seal(peer, session, report.encode(), path, now, is_answer=True)


def ask_for_echo(peer: Peer, session: Session, path: Path, now: float) -> list[Output]:
    """Send an echo request about a session on it."""
    peer.timers.stop(Timer.PROBE)  # until traffic asks for another
    peer.traffic.echoes_unanswered += peer.echo_requests.expire(now)
    session.held.asked(now)
    session.verification.asked(now)
    peer.set_freshness()
    echo = wire.Echo(False, peer.echo_requests.add(session, now), session.received, session.expected)
    out = seal(peer, session, echo.encode(), path, now)
    peer.asked_at = now
    peer.echo_at = now + peer.durations.echo_after_s
    return out


def challenge(peer: Peer, session: Session, path: Path, size: int, now: float) -> list[Output]:
    """Challenge a new path, never with more bytes than the ``size`` of what just came from there."""
    if session.envelope_bytes(wire.CHALLENGE_BYTES) > size:
        return []
    record = peer.challenger.challenge(path, now)
    if record is None:
        return []
    peer.timers.set(Timer.CHALLENGE_EXPIRY, peer.challenger.next_expiry())
    return seal(peer, session, record.encode(), path, now)
