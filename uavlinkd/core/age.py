"""The age of what one peer sends: which frames are delivered, which wait, and what the peer is asked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.constants import NEVER
from uavlinkd.core.drops import DropReason
from uavlinkd.core.freshness import Questions
from uavlinkd.core.outputs import Deliver, FreshnessUnverified, FreshnessVerified, Output
from uavlinkd.core.session import Session
from uavlinkd.core.settings import Screen

if TYPE_CHECKING:
    from uavlinkd.core.peer import Peer


class Age:
    """Judges frames of a peer by its answers to echo requests. Methods append what the shell has to do to ``out``.

    ``screen`` tells frames that may be old from those that must be new.
    """

    def __init__(self, peer: Peer, screen: Screen) -> None:
        self.unverified_since: float | None = None
        """When unverified freshness was reported; None while frames are known to be new."""
        self._peer = peer
        self._screen = screen
        self._questions = Questions()

    # Frames.

    def deliver(self, session: Session, counter: int, payload: bytes, now: float, out: list[Output]) -> None:
        """Frames arrive, after no silence: ask for an echo if one is due. Hold what must be new, if unverified."""
        verification = session.verification
        if now >= verification.ask_at and self._peer.sessions.is_in_use(session):
            verification.wait()
            self._ask(session, now, out)
            self._peer.wake_at(verification.due_at)
        if now <= verification.until:
            out.append(Deliver(self._peer.name, payload))
            return
        if self.unverified_since is None and now > verification.until + c.DOUBT_S:
            self.unverified_since = now
            out.append(FreshnessUnverified(self._peer.name))
        passing, waiting = self._screen(payload)
        if passing:
            out.append(Deliver(self._peer.name, passing))
        if waiting:
            self.hold(session, counter, waiting, now, out)

    def hold(self, session: Session, counter: int, payload: bytes, now: float, out: list[Output]) -> None:
        """Keep frames until the peer says how old they are."""
        self._peer.drop(DropReason.DOUBTFUL, session.doubt.hold(counter, payload, now), out)
        self.doubt(session, now, out)

    def doubt(self, session: Session, now: float, out: list[Output]) -> None:
        """Something came that may be old: ask the peer."""
        if session not in self._peer.sessions.confirmed:  # it ended as soon as it was confirmed
            self._give_up(session, out)
        elif session.doubt.begin(now):
            self._ask(session, now, out)
            self._peer.wake_at(session.doubt.due_at)

    # Questions and answers.

    def ask(self, session: Session, now: float) -> int:
        """The token of an echo request that is sent now on this session."""
        self._peer.traffic.echoes_unanswered += self._questions.expire(now)
        session.doubt.asked(now)
        session.verification.asked(now)
        return self._questions.ask(session, now)

    def receive_answer(self, echo: wire.Echo, now: float, out: list[Output]) -> None:
        """The peer says which counters are new, on the session on which it was asked."""
        peer = self._peer
        peer.traffic.echoes_unanswered += self._questions.expire(now)
        question = self._questions.find(echo.token)
        if question is None:
            if self._questions.is_issued(echo.token):
                self._refute()
            return
        if question.is_answered:
            return
        question.is_answered = True
        peer.round_trip_s = now - question.asked_at
        session = question.session
        if session is None:
            return
        session.refuse_below(echo.fresh)
        session.verification.answered(question.asked_at, now)
        if self.unverified_since is not None:
            out.append(FreshnessVerified(peer.name, now - self.unverified_since))
            self.unverified_since = None
        if peer.round_trip_s <= c.DOUBT_S:
            session.trusted_until = now + c.LATE_AFTER_S
            peer.heard(now, out)
            new, late = session.doubt.end(echo.fresh)
            out += [Deliver(peer.name, payload) for payload in new]
            peer.drop(DropReason.DELAYED, late, out)

    def handle_timeout(self, session: Session, now: float, out: list[Output]) -> None:
        """Ask again, and give up what waited for too long."""
        doubt, verification = session.doubt, session.verification
        if now >= doubt.due_at:
            self._peer.drop(DropReason.DOUBTFUL, doubt.give_up(now), out)
            if doubt.asks(now):
                self._ask(session, now, out)
        if now >= verification.due_at:
            if now > session.trusted_until:  # no frames arrive: the next one is asked about
                verification.rest()
            else:
                self._ask(session, now, out)

    def end(self, sessions: list[Session], out: list[Output]) -> None:
        """What ends with sessions: frames that waited, questions about them, and envelopes that did not arrive."""
        for session in sessions:
            self._give_up(session, out)
            self._questions.forget(session)
            self._peer.traffic.missing += session.missing(NEVER)

    def _ask(self, session: Session, now: float, out: list[Output]) -> None:
        assert self._peer.path is not None, "a session came along a path"
        self._peer.ask_for_echo(session, self._peer.path, now, out)

    def _refute(self) -> None:
        """An answer came late: so slow a path, or an attacker that stretches time. Nothing is known to be new."""
        for session in self._peer.sessions.confirmed:
            session.trusted_until = -NEVER
            session.verification.refute()

    def _give_up(self, session: Session, out: list[Output]) -> None:
        _, held = session.doubt.end(c.SESSION_ENVELOPE_LIMIT)
        self._peer.drop(DropReason.DOUBTFUL, held, out)
