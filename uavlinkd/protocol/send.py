"""What goes to a peer: frames and records in envelopes, and any datagram."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final, TypeVar

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Output, Transmit, new_tuple
from uavlinkd.protocol.path import FREE, Path
from uavlinkd.protocol.path_measures import NO_REPEATS
from uavlinkd.protocol.path_slots import Outlet, Route
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.settings import Class
from uavlinkd.protocol.timers import Timer
from uavlinkd.protocol.wire import QUESTION_BYTES

_NEARLY_WORN_OUT: Final = c.REKEY_AFTER_ENVELOPES - 2**20
"""From this counter on each call looks whether the keys may seal all its payloads, which are fewer than the rest."""
T = TypeVar("T")
STREAM, CRITICAL, PROBE, SILENCE = Class.STREAM, Class.CRITICAL, Timer.PROBE, Timer.SILENCE
"""Members that each frame needs. The class of an enumeration looks them up by a Python function."""


def send_frames(peer: Peer, frames: Sequence[bytes], now: float, cls: Class, along: Route = ()) -> list[Output]:
    """Put frames that are here together into as few envelopes as hold them, in their order.

    ``along``: the part of the route of this class along which they leave now. By default the whole route.
    """
    session, paths = peer.sessions.current, peer.paths
    outlet = paths.outlet
    if outlet is not None and cls is STREAM:
        of_session, route, limit, until = outlet
        if of_session is session and now < until:
            if len(frames) == 1 and len(frames[0]) <= limit:
                return send_payloads(peer, session, frames, route, now)
            if paths.shares_envelopes:
                return _send_shared(peer, frames, outlet, now)
    paths.outlet = None
    route = paths.routes[cls]
    keeps = cls is CRITICAL and paths.has_relayed  # also without a route
    if session is None or now >= session.reject_at or session.send_counter >= c.SESSION_ENVELOPE_LIMIT:
        return peer.drop(DropReason.NO_SESSION, len(frames))
    if not route:
        return _keep(peer, session, frames, now) if keeps else peer.drop(DropReason.NO_SESSION, len(frames))
    if peer.timers.deadlines[PROBE] == NEVER and peer.durations.probe_interval_s:
        # On a slow network, a request about freshness measures the round trip too: it comes first if frames arrive.
        least_s = (1 + c.VERIFY_REPEAT_SHARE) * paths.pace.interval_s
        peer.timers.set(PROBE, now + max(peer.durations.probe_interval_s, least_s))
    limit = session.payload_limit - max(0, session.max_envelope - paths.longest[cls])
    outlet, asks = new_tuple(Outlet, (session, along or route, limit, session.reject_at)), False
    if len(frames) > 1 and not paths.shares_envelopes:
        paths.shares_envelopes = True
        paths.schedule(now)
        peer.set_paths_timer()
    if len(paths.by_path) > 1:
        _note_activity(peer, now)
    elif cls is STREAM and not paths.is_multiple:
        paths.outlet = outlet
    if paths.is_multiple and cls is not CRITICAL and len(route) == 1:
        asks = now >= route[0].question_at - c.QUESTION_EARLY_S
    if len(frames) == 1 and len(frames[0]) <= limit and not asks:
        out = send_payloads(peer, session, frames, outlet.route, now)
    else:
        out = _send_shared(peer, frames, outlet, now, asks=asks)
    if keeps:
        sent = (output.datagram for output in out if isinstance(output, Transmit))
        _remember(peer, dict.fromkeys(sent), now)
    return out


def _send_shared(
    peer: Peer, frames: Sequence[bytes], outlet: Outlet, now: float, *, asks: bool = False
) -> list[Output]:
    """Send frames that share envelopes. ``asks``: with a question along the only path."""
    session, route, limit, _ = outlet
    fitting = [frame for frame in frames if len(frame) <= session.payload_limit]
    payloads = list(map(b"".join, batches(fitting, len, limit)))
    out: list[Output] = []
    if asks and payloads:
        out = send_payloads(peer, session, payloads[:-1], route, now)  # the question counts them
        payloads = [_ask_too(peer, session, route[0], payloads[-1], limit, now)]
    out += send_payloads(peer, session, payloads, route, now)
    return out + peer.drop(DropReason.TOO_LARGE, len(frames) - len(fitting))


def batches(frames: Iterable[T], size_of: Callable[[T], int], limit: float) -> list[list[T]]:
    """Frames in as few batches of at most ``limit`` bytes as hold them; a longer frame has one of its own."""
    made: list[list[T]] = []
    room = -1.0
    for frame in frames:
        size = size_of(frame)
        if size > room:
            made.append([])
            room = limit
        made[-1].append(frame)
        room -= size
    return made


def _remember(peer: Peer, datagrams: Iterable[bytes], now: float) -> None:
    peer.recent += ((now, datagram) for datagram in datagrams)
    del peer.recent[: -c.RESENT_ENVELOPES]


def _keep(peer: Peer, session: Session, frames: Sequence[bytes], now: float) -> list[Output]:
    """The last handle has ended. The next one is perhaps on its way: it carries what is critical."""
    left = c.SESSION_ENVELOPE_LIMIT - session.send_counter
    fitting = [frame for frame in frames if len(frame) <= session.payload_limit][:left]
    _remember(peer, [session.seal(frame, now) for frame in fitting], now)
    return peer.drop(DropReason.TOO_LARGE, len(frames) - len(fitting)) if len(fitting) < len(frames) else []


def resend(peer: Peer, state: PathState, now: float) -> list[Output]:
    """Send the recent critical envelopes of the current session along a new path too. Each is sent again once."""
    session = peer.sessions.current
    out: list[Output] = []
    for sent_at, datagram in peer.recent:
        is_current = session is not None and wire.claimed_receiver_index(datagram) == session.remote_index
        if now <= sent_at + c.RESENT_S and is_current and peer.paths.carries(state, len(datagram)):
            out.append(send_again(peer, state, datagram))
    peer.recent = []
    return out


def send_again(peer: Peer, state: PathState, datagram: bytes, number: int = 1) -> Transmit:
    """Send a sealed envelope along one path more (``number`` 1), or again along one that has carried it (from 2).

    It is counted now, when it leaves. The loss of a path is that of the current session.
    """
    session = peer.sessions.current
    if session is not None and wire.claimed_receiver_index(datagram) == session.remote_index:
        state.note_transmission(number)
    state.note_sent(len(datagram))
    return Transmit(datagram, state.path)


def _note_activity(peer: Peer, now: float) -> None:
    """Frames are sent: an idle link, or a stream that begins, is probed more often from now on."""
    paths = peer.paths
    begins = paths.is_idle(now)
    paths.active_at = now
    if paths.note_stream(now) or begins:
        paths.schedule(now)
        peer.set_paths_timer()


def _ask_too(peer: Peer, session: Session, state: PathState, frames: bytes, limit: int, now: float) -> bytes:
    """The payload of a stream envelope: with the question in front that is due soon, if there is room for it."""
    size = len(frames) + QUESTION_BYTES
    if size > limit or not state.allows(session.envelope_bytes(size)):
        return frames
    record = state.make_probe(peer.new_question(), 0, now)
    peer.paths.schedule(now)
    peer.set_paths_timer()
    return record.encode(frames)


def send_payloads(
    peer: Peer,
    session: Session,
    payloads: Sequence[bytes],
    route: Route,
    now: float,
    *,
    is_answer: bool = False,
) -> list[Output]:
    """Send each payload in an envelope, the same bytes along each path of a route.

    They expect an answer, unless they are one: two ends must not answer each other endlessly.
    """
    out: list[Output] = []
    is_counted = session is peer.sessions.current
    if session.send_counter > _NEARLY_WORN_OUT:
        payloads = _limited(peer, session, payloads, now, out)
    is_alone = len(route) == 1 and route[0].is_proven
    for payload in payloads:
        datagram = session.seal(payload, now)
        size = len(datagram)
        for state in route if is_alone else peer.paths.carrying(route, size):
            state.sent += is_counted
            state.datagrams_sent += 1
            state.bytes_sent += size
            out.append(new_tuple(Transmit, (datagram, state.path)))
    if not payloads:
        return out
    peer.sent_at = now
    if peer.unanswered_since is None and not is_answer:
        peer.unanswered_since = now
        peer.echo_at = now + peer.echo_after_s
        if now + peer.silence_s < peer.timers.deadlines[SILENCE]:
            peer.timers.set(SILENCE, now + peer.silence_s)
    return out


def _limited(
    peer: Peer, session: Session, payloads: Sequence[bytes], now: float, out: list[Output]
) -> Sequence[bytes]:
    """The payloads that the keys may still seal. From :data:`c.REKEY_AFTER_ENVELOPES` on there are to be new keys."""
    if session.send_counter < c.REKEY_AFTER_ENVELOPES <= session.send_counter + len(payloads):
        peer.timers.set(Timer.INITIATE, now)
    left = c.SESSION_ENVELOPE_LIMIT - session.send_counter
    out += peer.drop(DropReason.NO_SESSION, max(0, len(payloads) - left))
    return payloads[:left]


def transmit(peer: Peer, datagram: bytes, path: Path) -> Transmit:
    """Send a handshake message. Only what goes where the peer may be counts towards the budget of its link."""
    state = peer.paths.find(path)
    if state is None:
        peer.traffic.bytes_elsewhere += len(datagram)
    else:
        state.note_sent(len(datagram))
    return Transmit(datagram, path)


def send_echo(peer: Peer, session: Session, echo: wire.Echo, route: Route, now: float) -> list[Output]:
    """Send an echo request or a reply."""
    if len(route) > 1:
        route = (route[0], *(state for state in route[1:] if may_echo(peer, state, now, is_reply=echo.is_reply)))
    return send_payloads(peer, session, (echo.encode(),), route, now, is_answer=echo.is_reply)


def may_echo(peer: Peer, state: PathState, now: float, *, is_reply: bool) -> bool:
    """Whether a path gets a copy of an echo request, or of a reply: a slow one, no more than it would as the best."""
    pace = peer.paths.facts.pace(state.path)
    if pace is FREE:
        return True
    if now < state.echo_at[is_reply]:
        return False
    state.echo_at[is_reply] = now + pace.ask_s
    return True


def ask_for_echo(peer: Peer, session: Session, now: float, route: Route = ()) -> list[Output]:
    """Send an echo request about a session on it, along every proven path unless another ``route`` is given.

    A request that is repeated if it is lost goes along the best path first: ``paths.echo_route``.
    """
    peer.timers.stop(PROBE)  # until traffic asks for another
    peer.paths.outlet = None
    peer.traffic.echoes_unanswered += peer.echo_requests.expire(now)
    repeat_s = peer.echo_requests.repeat_s(session.held.pace)
    if not route:
        session.held.asked(now, repeat_s)
    session.verification.asked(now, repeat_s)
    peer.set_freshness()
    repeats = NO_REPEATS if peer.paths.best is None else peer.paths.best.repeats
    token = peer.echo_requests.add(session, now, session.send_counter + 1 - session.uncounted, repeats)
    echo = wire.Echo(False, token, session.received, session.expected)
    out = send_echo(peer, session, echo, route or peer.paths.routes[CRITICAL], now)
    peer.asked_at = now
    peer.echo_at = now + max(peer.echo_after_s, repeat_s)
    return out
