"""The sessions with one peer: next, current, previous.

*Next* are sessions that answer an initiation and wait for the envelope that confirms them. *Current* is the one that
sends. *Previous* are confirmed ones that only receive until they age out.

Confirmed sessions are ranked by what both ends know: the generation agreed in the handshake, and between two of the
same generation (both ends initiated at once) the one that the smaller static public key initiated. Both ends send on
the highest that they hold, so they settle on the same one without a word about it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from uavlinkd.core import constants as c
from uavlinkd.core.indices import Indices
from uavlinkd.core.path import Path
from uavlinkd.core.session import Session


@dataclass(slots=True)
class Unconfirmed:
    """A session that answers an initiation; the first valid envelope on it confirms it."""

    session: Session
    initiation_mac1: bytes
    """Of the initiation that it answers: a copy of it along another path gets the same response."""
    initiation_bytes: int
    response: bytes
    """Without macs."""
    paths: list[Path]
    """Where the response went, the first one first."""
    is_expected: bool
    """Whether that is where the peer is, as far as is known: others must not push it out."""
    mac1: bytes
    """Of the response; a cookie reply refers to it."""
    expires_at: float
    cookied: set[Path] = field(default_factory=set)
    """Paths along which a cookie reply to it was accepted: a second one is not."""

    @property
    def response_bytes(self) -> int:
        """Length of the response with its macs."""
        return len(self.response) + 2 * c.MAC_BYTES


class Sessions:
    """At most :data:`c.USABLE_PER_PEER` confirmed and :data:`c.UNCONFIRMED_PER_PEER` unconfirmed sessions.

    The table of indices, shared by all peers, is kept in step: an index that carried a confirmed session goes into
    quarantine, any other is free at once.
    """

    __slots__ = ("_has_smaller_key", "_highest", "_indices", "_peer", "confirmed", "current", "unconfirmed")

    def __init__(self, indices: Indices[object], peer: str, *, has_smaller_key: bool) -> None:
        self._highest = 0
        self._indices = indices
        self._peer = peer
        self._has_smaller_key = has_smaller_key
        self.current: Session | None = None
        """The session that sends: the first of the confirmed ones."""
        self.confirmed: list[Session] = []
        """The highest rank first."""
        self.unconfirmed: dict[int, Unconfirmed] = {}
        """By our index, the oldest first."""

    @property
    def generation(self) -> int:
        """Of the current session; 0 without one."""
        return 0 if self.current is None else self.current.parameters.generation

    def wait(self, unconfirmed: Unconfirmed) -> None:
        """Keep a session until it is confirmed; when there are too many, the oldest that was not expected goes."""
        while len(self.unconfirmed) >= c.UNCONFIRMED_PER_PEER:
            oldest = next(iter(self.unconfirmed))
            unexpected = (index for index, waiting in self.unconfirmed.items() if not waiting.is_expected)
            self._forget(next(unexpected, oldest))
        self.unconfirmed[unconfirmed.session.local_index] = unconfirmed

    def confirm(self, session: Session, now: float) -> list[Session]:
        """The peer proved that it has the session: give it the place of its rank. Returns what ends."""
        self.unconfirmed.pop(session.local_index, None)
        self.confirmed = sorted([session, *self.confirmed], key=self._rank, reverse=True)
        is_highest = self.confirmed[0] is session
        self._highest += 2 * is_highest  # one number is left for a session that ranks below
        session.order_base = (self._highest - (not is_highest)) << 32
        return self._end(self.confirmed[c.USABLE_PER_PEER :], now)

    def end_up_to(self, session: Session, now: float) -> list[Session]:
        """End this session and those ranked below it: a late close does not end what came after a restart."""
        rank = self._rank(session)
        return self._end([other for other in self.confirmed if self._rank(other) <= rank], now)

    def expire(self, now: float) -> list[Session]:
        """Drop the keys of sessions that are too old, and sessions that were not confirmed. Returns what ends."""
        for index in [index for index, waiting in self.unconfirmed.items() if now >= waiting.expires_at]:
            self._forget(index)
        return self._end([session for session in self.confirmed if now >= session.reject_at], now)

    def clear(self, now: float) -> list[Session]:
        """Drop every key. Returns what ends."""
        for index in list(self.unconfirmed):
            self._forget(index)
        return self._end(list(self.confirmed), now)

    def is_superseded(self, session: Session, now: float) -> bool:
        """Whether the peer has been sending on a session of higher rank since :data:`c.LATE_AFTER_S` ago.

        Frames on this one were sent before that: an attacker held them back.
        """
        for higher in self.confirmed:
            if higher is session:
                break
            if now >= higher.first_received_at + c.LATE_AFTER_S:
                return True
        return False

    def is_in_use(self, session: Session) -> bool:
        """Whether the peer may go on sending on this session: nothing came yet on one of higher rank."""
        for higher in self.confirmed:
            if higher is session or higher.first_received_at != c.NEVER:
                return higher is session
        return False

    def next_expiry(self) -> float:
        """When :meth:`expire` has something to do."""
        moments = [session.reject_at for session in self.confirmed]
        moments += [waiting.expires_at for waiting in self.unconfirmed.values()]
        return min(moments, default=c.NEVER)

    def _rank(self, session: Session) -> tuple[int, bool, float]:
        # The age decides only where an end restarted before its session was known to count, or lies.
        by_smaller = session.is_initiator == self._has_smaller_key
        return session.parameters.generation, by_smaller, session.created_at

    def _end(self, sessions: list[Session], now: float) -> list[Session]:
        for session in sessions:
            self.confirmed.remove(session)
            self._indices.retire(session.local_index, self._peer, now)
        self.current = self.confirmed[0] if self.confirmed else None
        return sessions

    def _forget(self, index: int) -> None:
        del self.unconfirmed[index]
        self._indices.forget(index)
