"""What a peer does when its timers expire."""

from __future__ import annotations

from typing import Final

from uavlinkd.protocol import freshness, probing
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.establish import initiate
from uavlinkd.protocol.outputs import Output, PathSuspected
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.send import ask_for_echo
from uavlinkd.protocol.timers import Timer


def _expire(peer: Peer, now: float) -> list[Output]:
    out: list[Output] = []
    peer.initiator.expire(now)
    if now >= peer.sessions.due_at:
        out += freshness.end(peer, peer.sessions.expire(now))
        if peer.is_up and peer.sessions.current is None:
            out += peer.note_lost(now)
        peer.set_initiate()
    peer.set_expiry()
    return out


def _handle_silence(peer: Peer, now: float) -> list[Output]:
    """Nothing came since something was sent: ask for an echo, initiate beside the session, give the peer up."""
    silent_since = peer.unanswered_since
    if silent_since is None:
        return []  # the next envelope sets the timer
    out: list[Output] = []
    handshake_at, lost_at = silent_since + peer.handshake_after_s, silent_since + peer.lost_after_s
    stages: list[float] = []
    if peer.is_up and now >= lost_at:
        out += peer.note_lost(now)
    if now >= handshake_at:
        peer.set_initiate()
    else:
        stages.append(handshake_at)
    if peer.is_up:
        stages.append(lost_at)
        session = peer.sending_session()
        if session is not None and peer.paths.best is not None:
            if now >= peer.echo_at:
                out += ask_for_echo(peer, session, now)
                if peer.paths.best.path.is_relayed:
                    out.append(PathSuspected(peer, peer.paths.best.path))
            stages.append(peer.echo_at)
    if stages:
        peer.timers.set(Timer.SILENCE, min(stages))
    return out


def _initiate(peer: Peer, now: float) -> list[Output]:
    if now >= peer.keys_wanted_at():
        return initiate(peer, now)
    peer.initiator.attempts = 0
    peer.set_initiate()
    return []


def _probe(peer: Peer, now: float) -> list[Output]:
    session = peer.sending_session()
    if session is None or peer.paths.best is None:
        return []
    return ask_for_echo(peer, session, now, peer.paths.echo_route)


def _keep_alive(peer: Peer, now: float) -> list[Output]:
    if peer.sending_session() is None or peer.paths.best is None:
        return []  # the next session sets the timer
    out = _probe(peer, now) if now >= _keepalive_at(peer) else []
    peer.timers.set(Timer.KEEPALIVE, _keepalive_at(peer))
    return out


def _keepalive_at(peer: Peer) -> float:
    """When an idle link is to be measured. Both ends do it, although the reply to the other keeps the path open too.

    While frames flow, the probe measures the link.
    """
    is_idle = peer.timers.deadlines[Timer.PROBE] == NEVER
    return (peer.asked_at if is_idle else peer.sent_at) + peer.durations.keepalive_s


_HANDLERS: Final = {
    Timer.EXPIRY: _expire,
    Timer.FRESHNESS: freshness.handle_timeout,
    Timer.PATHS: probing.handle_timeout,
    Timer.SILENCE: _handle_silence,
    Timer.INITIATE: _initiate,
    Timer.PROBE: _probe,
    Timer.KEEPALIVE: _keep_alive,
}


def handle_timeout(peer: Peer, now: float) -> list[Output]:
    """Do what is due at ``now``. Each handler sets its timer again."""
    return [output for timer in peer.timers.expired(now) for output in _HANDLERS[timer](peer, now)]
