"""How sessions with a peer begin and end: initiations, responses, confirmation, close."""

from __future__ import annotations

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import freshness, handshake, probing, wire
from uavlinkd.protocol.cookie import mac1_of
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.handshake import Received
from uavlinkd.protocol.initiator import Pending
from uavlinkd.protocol.outputs import Output, PeerAdmitted, PeerClosed, SessionEstablished
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.send import ask_for_echo, send_payloads, transmit
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.sessions import Unconfirmed
from uavlinkd.protocol.settings import Class
from uavlinkd.protocol.timers import Timer

# The initiator's side.


def initiate(peer: Peer, now: float) -> list[Output]:
    """Send the next initiation, and set when to repeat it. Without an address nothing is sent."""
    initiator = peer.initiator
    is_silent = peer.unanswered_since is not None and now >= peer.unanswered_since + peer.handshake_after_s
    is_answering = peer.is_up and not is_silent
    paths = peer.paths.handshake_paths(is_answering=is_answering)
    if not paths:
        return []
    if peer.keys_wanted_at() > initiator.initiated_at:  # none was wanted between the last initiation and this one
        initiator.attempts = 0
    if initiator.attempts and peer.is_up:
        peer.traffic.handshakes_unanswered += 1
    if initiator.attempts < c.REKEYS_ALONG_BEST and is_answering and peer.paths.works:
        paths = paths[:1]
    shown = initiator.shown(is_answering=is_answering)
    paths, due_at = initiator.take(paths, shown, now)
    initiator.begin_try(now, due_at)
    peer.set_initiate()
    if not paths:
        return []
    try:
        index = peer.indices.pick(now)
    except Drop as drop:  # every index is taken: as if the initiation had been lost
        return peer.drop(drop.reason, 1)
    pending, datagrams = initiator.initiate(index, paths, peer.sessions.generation, shown, now)
    peer.indices.owners[index] = peer, pending
    peer.set_expiry()
    return [transmit(peer, datagram, path) for datagram, path in datagrams]


def receive_response(peer: Peer, pending: Pending, response: wire.Response, path: Path, now: float) -> list[Output]:
    """The first response to an own initiation: the session is confirmed here, and the peer learns it at once.

    Raises Drop: as :meth:`Initiator.receive_response`; then nothing was changed.
    """
    keys = peer.initiator.receive_response(pending, response)
    lifetimes = peer.durations.reject_after_s, peer.verify_interval_s
    session = Session(keys, response.receiver_index, now, *lifetimes, is_initiator=True)
    # A peer that answers many initiations at once answers the first envelopes as late.
    peer.handshake_s = min(now - pending.sent_at, c.LATE_AFTER_S)
    peer.sessions.note_twin(peer.sessions.twin(keys.parameters.generation - 1), now)
    if path not in pending.paths:  # it was sent on from elsewhere, or our network changed
        path = pending.paths[0]
    events = adopt(peer, session, path, now) + peer.note_received(now)
    # The confirmation; any later envelope repeats it. It asks for an echo: so it is long enough to be challenged if a
    # relay sends it from elsewhere, and it gives the round trip at once.
    if session is not peer.sessions.current:
        state = peer.paths.find(path)
        return ask_for_echo(peer, session, now, () if state is None else (state,)) + events
    out = ask_for_echo(peer, session, now) + events
    return out + probing.ask_everywhere(peer, session, now)


def receive_hint(peer: Peer, now: float) -> list[Output]:
    """An envelope for a session unknown here came from the peer's address: perhaps this daemon restarted."""
    silent_since = peer.unanswered_since
    is_silent = silent_since is not None and now >= silent_since + peer.echo_after_s
    if peer.sessions.current is not None and not is_silent:
        return []  # the peer sends on a session of ours: the hint is false, and anyone can replay an old envelope
    if now < peer.hinted_at + c.HINTS_INTERVAL_S or not peer.settings.initiates:
        return []
    peer.hinted_at = now
    return initiate(peer, now)


# The responder's side.


def answer(peer: Peer, received: Received, initiation: bytes, path: Path, now: float) -> list[Output]:
    """Answer an authentic initiation. The session waits, beside what is there, until it is confirmed.

    Raises ``NO_FREE_INDEX`` or ``INVALID_KEY_SHARE``.
    """
    index = peer.indices.pick(now)
    response, keys = handshake.respond(received, peer.settings, index, peer.sessions.generation, peer.entropy)
    datagram = peer.initiator.add_macs(response, path, now)
    lifetimes = peer.durations.reject_after_s, peer.verify_interval_s
    session = Session(keys, index, now, *lifetimes, is_initiator=False)
    is_expected, expires_at = peer.paths.find(path) is not None, now + c.UNCONFIRMED_LIFETIME_S
    macs = mac1_of(initiation), mac1_of(datagram)
    twin = peer.sessions.twin(received.parameters.generation)
    facts = session, macs[0], len(initiation), response, [path], is_expected, macs[1], expires_at
    certificate = received.certificate if peer.settings.is_certified else b""
    waiting = Unconfirmed(*facts, certificate, twin)
    peer.sessions.wait(waiting)
    peer.indices.owners[index] = peer, session
    peer.set_expiry()
    return _transmit_answer(peer, datagram, waiting, path)


def answer_copy(peer: Peer, waiting: Unconfirmed, path: Path, now: float) -> list[Output]:
    """A copy of an answered initiation came along another path: the same response goes back there, once."""
    if path in waiting.paths or len(waiting.paths) >= c.COPIES_OF_A_RESPONSE:
        return []
    waiting.paths.append(path)
    return _transmit_answer(peer, peer.initiator.add_macs(waiting.response, path, now), waiting, path)


def _transmit_answer(peer: Peer, datagram: bytes, waiting: Unconfirmed, path: Path) -> list[Output]:
    if (state := peer.paths.find(path)) is not None:
        state.datagrams_received += 1
        state.bytes_received += waiting.initiation_bytes  # that came there: the response is no amplification
    return [transmit(peer, datagram, path)]


# Both sides.


def adopt(peer: Peer, session: Session, path: Path, now: float, certificate: bytes = b"") -> list[Output]:
    """A session is confirmed, by a datagram along this path. If it has the highest rank, traffic goes on it now.

    ``certificate``: that its initiation showed.
    """
    is_rekey = peer.sessions.current is not None
    admitted: list[Output] = [PeerAdmitted(peer, certificate)] if certificate else []
    peer.provisional_until = c.NEVER
    peer.indices.owners[session.local_index] = peer, session
    out = admitted + freshness.end(peer, peer.sessions.confirm(session, now))
    peer.initiator.cancel()
    peer.initiator.is_known = True
    peer.initiator.attempts = 0
    peer.traffic.handshakes += 1
    if peer.sessions.current is session:
        peer.established_at = now
        peer.traffic.reported = (0, 0)
        peer.timers.set(Timer.KEEPALIVE, peer.sent_at + peer.durations.keepalive_s)
        agreed = session.parameters
        facts = agreed.generation, session.suite.name, agreed.confidential, session.tag_bytes, session.is_initiator
        out.append(SessionEstablished(peer, path, *facts, is_rekey))
        peer.paths.prefer(path, now)
        for state in peer.paths.states:
            state.note_session()
        out += probing.update(peer, now)
    else:
        probing.follow_paths(peer, now)
    peer.set_expiry()
    peer.set_initiate()
    return out


def receive_close(peer: Peer, session: Session, now: float) -> list[Output]:
    """The peer ends this session and those ranked below it."""
    out: list[Output] = [] if peer.early is None else peer.early.release(c.NEVER)
    out += freshness.end(peer, peer.sessions.end_up_to(session, now))
    if peer.sessions.current is None:
        peer.is_up = False
        peer.unverified_since = None
        peer.unanswered_since = None
        peer.initiator.is_known = False  # it may restart, and forget certificates
        peer.initiator.attempts = 0
        peer.initiator.retry_at = now + c.CLOSE_HOLDOFF_S
        out.append(PeerClosed(peer))
    peer.set_initiate()
    return out


def close(peer: Peer, now: float, *, sends: bool = True) -> list[Output]:
    """Send a close on the current session, unless ``sends`` is false, and forget every key."""
    session, out = peer.sessions.current, list[Output]()
    try:
        if sends and session is not None and now < session.reject_at:
            out += send_payloads(peer, session, (wire.Close().encode(),), peer.paths.routes[Class.CRITICAL], now)
    finally:  # also if no close can be sent
        ended = peer.sessions.clear(now)
    out += freshness.end(peer, ended)
    peer.initiator.cancel()
    peer.is_up = False
    peer.timers.stop_all()
    peer.early = None
    return out
