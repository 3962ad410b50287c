"""One peer: what it may make us do, what we owe it, and when."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from uavlinkd.core import constants as c
from uavlinkd.core import handshake, wire
from uavlinkd.core.age import Age
from uavlinkd.core.initiator import Caller, Pending
from uavlinkd.core.constants import NEVER
from uavlinkd.core.cookie import mac1_of
from uavlinkd.core.crypto import Entropy, KeyPair
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.group_budget import GroupShare
from uavlinkd.core.handshake import Keys, Received
from uavlinkd.core.indices import Indices
from uavlinkd.core.limits import TokenBucket
from uavlinkd.core.outputs import (
    Deliver,
    Dropped,
    Output,
    Path,
    PathChanged,
    PeerClosed,
    PeerLost,
    PeerUp,
    SessionEstablished,
    Transmit,
)
from uavlinkd.core.path import Challenger
from uavlinkd.core.session import Session
from uavlinkd.core.sessions import Sessions, Unconfirmed
from uavlinkd.core.settings import PeerSettings, Screen
from uavlinkd.core.suites import Suite
from uavlinkd.core.traffic import Traffic

_CHALLENGED = bytes((wire.PATH_CHALLENGE,))  # gets an answer: with a question beside it, more would go back than came


class Peer:
    """The state of the link with one peer. Methods append what the shell has to do to ``out``."""

    def __init__(
        self,
        settings: PeerSettings,
        identity: KeyPair,
        indices: Indices,
        entropy: Entropy,
        now: float,
        screen: Screen,
    ) -> None:
        self.settings = settings
        self.name = settings.name
        self.timers = settings.link.timers
        self.verify_interval_s = settings.link.verify_interval_s
        """Of the sessions that are made from now on."""
        self.caller = Caller(self, settings, identity, indices, entropy, now)
        self.sessions = Sessions(indices, has_smaller_key=identity.public < settings.public_key)
        self.traffic = Traffic()
        self.answers = TokenBucket(c.ANSWERS_PER_S, c.ANSWERS_BURST, now)
        """Responses that it may get without a cookie."""
        self.answers_while_up = TokenBucket(c.ANSWERS_WHILE_UP_PER_S, c.ANSWERS_BURST, now)
        self.cookied_answers = TokenBucket(c.COOKIED_ANSWERS_PER_S, c.COOKIED_ANSWERS_PER_S, now)
        """And with one, to all addresses together."""
        self.group_share = GroupShare(now)
        """Of the CPU time for the groups of its suites."""
        self.remembered: deque[bytes] = deque()
        """Ephemerals of its initiations, the oldest first."""
        self.path: Path | None = None
        """Where the peer is known to hear us; traffic goes there."""
        self.is_up = False
        self.established_at: float | None = None
        self.heard_at: float | None = None
        self.round_trip_s: float | None = None
        self.deadline = now
        """When :meth:`handle_timeout` has something to do; may be early, never late."""
        self._indices = indices
        self._entropy = entropy
        self._challenger = Challenger(entropy, self.traffic)
        self._hinted_at = -NEVER
        self._sent_at = now
        self._unanswered_since: float | None = None
        self._echo_at = NEVER  # ask for an echo then, if still nothing is heard
        self._probe_at = NEVER  # measure the round trip then
        self._age = Age(self, screen)

    # Sending.

    def send(self, frames: Sequence[bytes], now: float, out: list[Output]) -> None:
        """Put frames that are here together into as few envelopes as hold them, in their order."""
        session = self.sessions.current
        if session is None or self.path is None or not session.is_usable(now):
            self.drop(DropReason.NO_SESSION, len(frames), out)
            return
        if self._probe_at == NEVER and self.timers.probe_interval_s:
            self._probe_at = now + self.timers.probe_interval_s
            self.wake_at(self._probe_at)
        limit = session.payload_limit
        batch: list[bytes] = []
        size = 0
        for frame in frames:
            if size + len(frame) > limit:
                if batch:
                    self._seal(session, b"".join(batch), self.path, now, out)
                    batch, size = [], 0
                if len(frame) > limit:
                    self.drop(DropReason.TOO_LARGE, 1, out)
                    continue
            batch.append(frame)
            size += len(frame)
        if batch:
            self._seal(session, b"".join(batch), self.path, now, out)

    def close(self, now: float, out: list[Output]) -> None:
        """Say goodbye on the current session and forget every key."""
        session = self.sessions.current
        if session is not None and self.path is not None and now < session.reject_at:
            self._seal(session, wire.Close().encode(), self.path, now, out)
        self._age.end(self.sessions.clear(now), out)
        self.caller.cancel()
        self.is_up = False
        self.deadline = NEVER

    def _seal(
        self, session: Session, payload: bytes, path: Path, now: float, out: list[Output], *, is_answer: bool = False
    ) -> None:
        """Send an envelope. Silence after it is suspect, unless it is an answer: those would echo for ever."""
        if session.send_counter >= c.SESSION_ENVELOPE_LIMIT:
            self.drop(DropReason.NO_SESSION, 1, out)
            return
        self.traffic.envelopes_sent += 1
        self._transmit(Transmit(session.seal(payload, now), path), out)
        self._sent_at = now
        if self._unanswered_since is None and not is_answer:
            self._unanswered_since = now
            self._echo_at = now + self.timers.echo_after_s
            self.wake_at(self._echo_at)

    def _transmit(self, transmit: Transmit, out: list[Output]) -> None:
        if transmit.path is self.path or transmit.path in self.caller.candidates(self.path):
            self.traffic.datagrams_sent += 1
            self.traffic.bytes_sent += len(transmit.datagram)
        else:
            self.traffic.bytes_elsewhere += len(transmit.datagram)
        out.append(transmit)

    def drop(self, reason: DropReason, amount: int, out: list[Output]) -> None:
        """Of frames on their way out, or of envelopes that waited to be delivered."""
        if amount:
            self.traffic.drops[reason] += amount
            out.append(Dropped(reason, self.name, None, amount))

    def wake_at(self, moment: float) -> None:
        """Have :meth:`handle_timeout` called by then."""
        self.deadline = min(self.deadline, moment)

    # Receiving on a session.

    def receive_envelope(
        self,
        session: Session,
        datagram: bytes,
        header_bytes: int,
        counter: int,
        path: Path,
        now: float,
        out: list[Output],
    ) -> None:
        """Open an envelope and act on it.

        Raises:
            Drop: as :meth:`Session.open`; then nothing was changed. ``BAD_CONTROL`` or ``BAD_PATH_RESPONSE``
                for authentic nonsense.
        """
        payload = session.open(datagram, header_bytes, counter, now)
        self.traffic.envelopes_received += 1
        self.traffic.bytes_received += len(datagram)
        unconfirmed = self.sessions.unconfirmed.pop(session.local_index, None)
        if unconfirmed is not None:
            self._adopt(session, unconfirmed.path, now, out)
        is_late = self.sessions.is_left_behind(session, now)
        is_new = now <= session.trusted_until and not is_late
        if is_new:
            session.trusted_until = now + c.LATE_AFTER_S
            self.heard(now, out)
        elif not self.is_up and not is_late:
            self._age.doubt(session, now, out)
        if counter != session.window.highest:
            self.traffic.out_of_order += 1
        elif path != self.path and session is self.sessions.current and payload[:1] != _CHALLENGED:
            self._challenge_path(session, path, len(datagram), now, out)
        if not payload:
            return
        if payload[0] < wire.FRAMES_FROM:
            self._receive_control(session, wire.parse_control(payload), path, now, out)
        elif is_new:
            if now < session.verification.look_at:
                out.append(Deliver(self.name, payload))
            else:
                self._age.deliver(session, counter, payload, now, out)
        elif is_late:
            self.drop(DropReason.DELAYED, 1, out)
        else:
            self._age.hold(session, counter, payload, now, out)

    def _receive_control(
        self, session: Session, control: wire.Control, path: Path, now: float, out: list[Output]
    ) -> None:
        match control:
            case wire.Echo() as echo:
                self._receive_echo(session, echo, now, out)
            case wire.PathChallenge(token):
                # Back to where it came from, known or not: that is the question. Shorter than the question.
                self._seal(session, wire.PathResponse(token).encode(), path, now, out, is_answer=True)
            case wire.PathResponse(token):
                self._receive_path_response(token, path, now, out)
            case wire.Close():  # pragma: no branch  # the last kind there is
                self._receive_close(session, now, out)

    def _receive_echo(self, session: Session, echo: wire.Echo, now: float, out: list[Output]) -> None:
        # A report of more than was sent, or than was expected, is a lie.
        if echo.received <= echo.expected <= session.send_counter:
            if session is self.sessions.current:
                self.traffic.reported = (echo.expected, echo.received)
            if echo.expected > session.fresh(now, c.DOUBT_S):
                session.verification.extend(now)
        if echo.is_reply:
            self._age.receive_answer(echo, now, out)
            return
        assert self.path is not None, "a session came along a path"
        # On the session that sends, whichever asked: else a peer that never had our newest session
        # would go on hearing us on an older one, and never call for what it misses.
        current = self.sessions.current or session
        reply = wire.Echo(True, echo.token, current.received, current.expected, session.fresh(now))
        self._seal(current, reply.encode(), self.path, now, out, is_answer=True)

    def heard(self, now: float, out: list[Output]) -> None:
        """Something authentic and new came from the peer."""
        self.heard_at = now
        self._unanswered_since = None
        if not self.is_up:
            self.is_up = True
            out.append(PeerUp(self.name))

    def take_held(self, out: list[Output]) -> None:
        """Hold no frames any more."""
        for session in self.sessions.confirmed:
            out += [Deliver(self.name, payload) for payload in session.doubt.take_held()]

    @property
    def unverified_since(self) -> float | None:
        """Since when frames arrive and none of them is known to be new; None while freshness is verified."""
        return self._age.unverified_since

    def missing(self, now: float) -> int:
        """Envelopes that the peer sent and that were not accepted, on all sessions so far; it only grows."""
        return self.traffic.missing + sum(each.missing(now) for each in self.sessions.confirmed)

    def _receive_close(self, session: Session, now: float, out: list[Output]) -> None:
        self._age.end(self.sessions.end_up_to(session, now), out)
        if self.sessions.current is None:
            self.is_up = False
            self._age.unverified_since = None
            self._unanswered_since = None
            self.caller.rest()
            self.caller.retry_at = now + c.CLOSE_HOLDOFF_S
            self.wake_at(self.caller.retry_at)
            out.append(PeerClosed(self.name))

    # Paths.

    def _challenge_path(self, session: Session, path: Path, size: int, now: float, out: list[Output]) -> None:
        """Ask along a new path, never with more bytes than just came from there."""
        if session.envelope_bytes(wire.CHALLENGE_BYTES) > size:
            return
        if (question := self._challenger.question(path, now)) is not None:
            self.wake_at(self._challenger.next_expiry())
            self._seal(session, question.encode(), path, now, out)

    def _receive_path_response(self, token: bytes, path: Path, now: float, out: list[Output]) -> None:
        if not self._challenger.take(token, path, now):
            raise Drop(DropReason.BAD_PATH_RESPONSE)
        self.path = path
        out.append(PathChanged(self.name, path))

    # Handshakes.

    def receive_response(self, pending: Pending, response: wire.Response, now: float, out: list[Output]) -> None:
        """The answer to our initiation: the session is ours, and the peer is told so at once.

        Raises:
            Drop: as :meth:`Caller.receive_response`; then nothing was changed.
        """
        keys = self.caller.receive_response(pending, response)
        session = self._session(response.suite, keys, response.receiver_index, now, is_initiator=True)
        events: list[Output] = []
        self._adopt(session, pending.path, now, events)
        self.heard(now, events)
        # The confirmation; any later envelope repeats it. It asks for an echo: long enough to be challenged where
        # somebody relays it from elsewhere, and it gives the round trip at once. It goes out before anyone hears of
        # the session: what that ends, such as a session by a previous key, must not end before the peer has this one.
        self.ask_for_echo(session, pending.path, now, out)
        out += events

    def receive_cookie(self, mac1: bytes, path: Path, reply: wire.CookieReply, now: float) -> None:
        """The peer is under load and asks us to prove our address.

        Raises:
            Drop: ``BAD_COOKIE``.
        """
        self.caller.receive_cookie(mac1, path, reply, now)
        self.wake_at(self.caller.retry_at)

    def hint(self, now: float, out: list[Output]) -> None:
        """An envelope for a session unknown here came from the peer's address: perhaps we restarted."""
        if self.sessions.current is not None and now < self._silent_for(self.timers.echo_after_s):
            return  # the peer speaks on a session of ours: the hint is false, and anyone can replay an old envelope
        if now >= self._hinted_at + c.HINTS_INTERVAL_S:
            self._hinted_at = now
            self._call(now, out)

    def answer(self, received: Received, path: Path, now: float, out: list[Output]) -> None:
        """Answer an authentic initiation. The session waits, beside what is there, until it is confirmed.

        Raises:
            Drop: ``NO_FREE_INDEX`` or ``INVALID_KEY_SHARE``.
        """
        suite = received.initiation.suite
        index = self._indices.pick(now)
        message, keys = handshake.respond(received, self.settings, index, self.sessions.generation, self._entropy)
        datagram = self.caller.add_macs(message, path, now)
        session = self._session(suite, keys, index, now, is_initiator=False)
        is_expected, expires_at = path in self.caller.candidates(self.path), now + c.UNCONFIRMED_LIFETIME_S
        self.sessions.wait(Unconfirmed(session, path, is_expected, mac1_of(datagram), expires_at))
        self.wake_at(expires_at)
        self._transmit(Transmit(datagram, path), out)

    def _session(self, suite: Suite, keys: Keys, index: int, now: float, *, is_initiator: bool) -> Session:
        lifetime_s, interval_s = self.timers.reject_after_s, self.verify_interval_s
        return Session(
            self, suite, keys, index, now, lifetime_s, is_initiator=is_initiator, verify_interval_s=interval_s
        )

    def _adopt(self, session: Session, path: Path, now: float, out: list[Output]) -> None:
        """A session is confirmed. Where it is the highest, traffic goes on it now, along the path that made it."""
        is_rekey = self.sessions.current is not None
        self._age.end(self.sessions.confirm(session, now), out)
        self.caller.cancel()
        self.caller.rest()
        self.traffic.handshakes += 1
        self.wake_at(now)
        if self.sessions.current is not session:
            return
        self.path = path
        self.established_at = now
        self.traffic.reported = (0, 0)
        self._challenger.forget()
        agreed = session.parameters
        facts = (agreed.generation, session.suite.name, agreed.confidential, session.tag_bytes, session.is_initiator)
        out.append(SessionEstablished(self.name, *facts, is_rekey))

    def _call(self, now: float, out: list[Output]) -> None:
        try:
            initiation = self.caller.call(self.path, self.sessions.generation, now)
        except Drop as drop:  # every index is taken: as if the initiation had been lost
            self.drop(drop.reason, 1, out)
            return
        if initiation is not None:
            self._transmit(initiation, out)
            self.wake_at(self.caller.retry_at)

    # Time.

    def handle_timeout(self, now: float, out: list[Output]) -> None:
        """Do what is due at ``now``."""
        self._age.end(self.sessions.expire(now), out)
        for each in self.sessions.confirmed:
            self._age.handle_timeout(each, now, out)
        self.caller.expire(now)
        self._challenger.expire(now)
        session = self.sessions.current
        if self.is_up and (session is None or now >= self._silent_for(self.timers.lost_after_s)):
            self.is_up = False
            self._age.unverified_since = None
            assert self.heard_at is not None, "a peer is up because it was heard"
            out.append(PeerLost(self.name, now - self.heard_at))
        if now < self._call_due_at():
            self.caller.rest()
        elif now >= self.caller.retry_at:
            self._call(now, out)
        if session is not None and self.path is not None and not session.is_used_up:
            if now >= min(self._echo_due_at(), self._probe_at):
                self.ask_for_echo(session, self.path, now, out)
            if now >= self._sent_at + self.timers.keepalive_s:
                self._seal(session, b"", self.path, now, out)
        self.deadline = self._next_deadline()

    def ask_for_echo(self, session: Session, path: Path, now: float, out: list[Output]) -> None:
        """Send an echo request about a session on it."""
        self._probe_at = NEVER  # until traffic asks for another
        echo = wire.Echo(False, self._age.ask(session, now), session.received, session.expected)
        self._seal(session, echo.encode(), path, now, out)
        self._echo_at = now + self.timers.echo_after_s

    def _silent_for(self, duration_s: float) -> float:
        """The moment at which we will have sent, and heard nothing, for ``duration_s``."""
        return NEVER if self._unanswered_since is None else self._unanswered_since + duration_s

    def _echo_due_at(self) -> float:
        return self._echo_at if self._unanswered_since is not None and self.is_up else NEVER

    def _call_due_at(self) -> float:
        """When new keys are wanted: at once without a session; else by count, by age, or by silence."""
        if not self.caller.candidates(self.path):
            return NEVER
        session = self.sessions.current
        if session is None or session.send_counter >= c.REKEY_AFTER_ENVELOPES:
            return -NEVER
        rekey_at = session.created_at + self.timers.rekey_after_s
        if not session.is_initiator:
            # The initiator goes first, so that in the ordinary case one side rekeys, not both.
            rekey_at += c.RESPONDER_REKEY_SHARE * (self.timers.reject_after_s - self.timers.rekey_after_s)
        return min(rekey_at, self._silent_for(self.timers.handshake_after_s))

    def _next_deadline(self) -> float:
        moments = [max(self.caller.retry_at, self._call_due_at())]
        moments += [self.sessions.next_expiry(), self.caller.next_expiry(), self._challenger.next_expiry()]
        moments += [min(each.doubt.due_at, each.verification.due_at) for each in self.sessions.confirmed]
        session = self.sessions.current
        if session is not None and self.path is not None and not session.is_used_up:
            moments += [self._sent_at + self.timers.keepalive_s, self._echo_due_at(), self._probe_at]
        if self.is_up:
            moments.append(self._silent_for(self.timers.lost_after_s))
        return min(moments)
