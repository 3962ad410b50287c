"""The sessions with one peer: next, current, previous.

*Next* are sessions that answer an initiation and wait for the envelope that confirms them. *Current* is the one that
sends. *Previous* are confirmed ones that only receive until they age out.

Confirmed sessions are ranked by what both ends know: the generation agreed in the handshake, and between two of the
same generation (both ends initiated at once) the one that the smaller static public key initiated. Both ends send on
the highest that they hold, so they settle on the same one without a word about it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import Entropy
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.path import FREE, Pace, Path
from uavlinkd.protocol.path_measures import NO_REPEATS, Repeats
from uavlinkd.protocol.session import Session

_DRAWS = 64  # with half of all indices taken, all draws fail once in 2^64

Owner_co = TypeVar("Owner_co", covariant=True)


class Indices(Generic[Owner_co]):
    """What each index leads to; unpredictable new ones; a quarantine for those that carried a session."""

    def __init__(self, entropy: Entropy) -> None:
        self.owners: dict[int, Owner_co] = {}
        """Without an owner, an index is free at once, unless it was retired."""
        self._entropy = entropy
        self._quarantine: dict[int, tuple[float, str]] = {}  # free again at, and whose; the oldest is first
        self._quarantined_of: dict[str, dict[int, None]] = {}  # the same by peer

    def pick(self, now: float) -> int:
        """An index without an owner: 1 to 65535. It stays free until it is put into :attr:`owners`.

        Raises ``NO_FREE_INDEX``.
        """
        self._release(now)
        for _ in range(_DRAWS):
            index = int.from_bytes(self._entropy(2), "big")
            if index and index not in self.owners and index not in self._quarantine:
                return index
        raise Drop(DropReason.NO_FREE_INDEX)

    def retire(self, index: int, peer: str, now: float) -> None:
        """The session of ``peer`` at ``index`` has ended; what still arrives for it is late."""
        self.owners.pop(index, None)
        self._quarantine[index] = now + c.INDEX_QUARANTINE_S, peer
        quarantined = self._quarantined_of.setdefault(peer, {})
        quarantined[index] = None
        if len(quarantined) > c.QUARANTINED_PER_PEER:
            self._free(next(iter(quarantined)))

    def is_quarantined(self, index: int, now: float) -> bool:
        """Whether a session ended at ``index`` recently."""
        return index in self._quarantine and self._quarantine[index][0] > now

    def _release(self, now: float) -> None:
        while self._quarantine:
            oldest = next(iter(self._quarantine))
            if self._quarantine[oldest][0] > now:
                return
            self._free(oldest)

    def _free(self, index: int) -> None:
        _, peer = self._quarantine.pop(index)
        del self._quarantined_of[peer][index]
        if not self._quarantined_of[peer]:
            del self._quarantined_of[peer]


class Twin(Enum):
    """Which private key a second process uses: README.md, section 9. Nothing acts on it."""

    PEERS = "peers"
    OURS = "ours"


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
    certificate: bytes
    """That the initiation of a peer by certificate shows; empty in the short form."""
    twin: Twin | None = None
    """What the initiation shows, once the session is confirmed: before that it may be an old recording."""
    cookied: set[Path] = field(default_factory=set)
    """Paths along which a cookie reply to it was accepted: a second one is not."""


class Sessions:
    """At most :data:`c.USABLE_PER_PEER` confirmed and twice :data:`c.UNCONFIRMED_PER_KIND` unconfirmed sessions.

    The table of indices, shared by all peers, is kept in step: an index that carried a confirmed session goes into
    quarantine, any other is free at once.
    """

    __slots__ = (
        *("_first_proofs", "_has_smaller_key", "_highest", "_indices", "_made", "_peer"),
        *("confirmed", "current", "twins", "unconfirmed"),
    )

    def __init__(self, indices: Indices[object], peer: str, *, has_smaller_key: bool) -> None:
        self._highest = self._made = 0
        self._indices = indices
        self._peer = peer
        self._has_smaller_key = has_smaller_key
        self.current: Session | None = None
        """The session that sends: the first of the confirmed ones."""
        self.confirmed: list[Session] = []
        """The highest rank first."""
        self.unconfirmed: dict[int, Unconfirmed] = {}
        """By our index, the oldest first."""
        self._first_proofs: dict[Twin, float] = {}
        self.twins: dict[Twin, float] = {}
        """When a handshake last proved that a second process uses a key, and was not the first that did."""

    @property
    def generation(self) -> int:
        """Of the current session; 0 without one."""
        return 0 if self.current is None else self.current.parameters.generation

    def twin(self, stated: int) -> Twin | None:
        """What the generation shows that the peer states in a handshake, if it completes that handshake.

        An end completes no handshake that it began before its present session. So a peer that knows less than it used
        here before is a second process with its key. One that knows a session that this end never made has it with a
        second process that has our key. A restarted end states 0, and takes any number.
        """
        used = (session for session in self.confirmed if session.first_received_at != c.NEVER)
        if 0 < stated < max((session.parameters.generation for session in used), default=0):
            return Twin.PEERS
        return Twin.OURS if self.current is not None and stated > self._made else None

    def note_twin(self, twin: Twin | None, now: float) -> None:
        """A handshake was completed that shows this. A late one of a process that was restarted can too, once."""
        if twin is None:
            return
        first = self._first_proofs.get(twin, -c.NEVER)
        if now - first > c.TWIN_PROOFS_WITHIN_S:
            self._first_proofs[twin] = now
        elif now - first >= c.TWIN_PROOFS_APART_S:
            self.twins[twin] = now

    def wait(self, unconfirmed: Unconfirmed) -> None:
        """Keep a session until it is confirmed. Too many of its kind, expected or not: the oldest of them goes."""
        is_expected, session = unconfirmed.is_expected, unconfirmed.session
        self._made = max(self._made, session.parameters.generation)
        alike = [index for index, other in self.unconfirmed.items() if other.is_expected == is_expected]
        if len(alike) >= c.UNCONFIRMED_PER_KIND:
            self._forget(alike[0])
        self.unconfirmed[session.local_index] = unconfirmed

    def confirm(self, session: Session, now: float) -> list[Session]:
        """The peer proved that it has the session: give it the place of its rank. Returns what ends."""
        if (waiting := self.unconfirmed.pop(session.local_index, None)) is not None:
            self.note_twin(waiting.twin, now)
        self._made = max(self._made, session.parameters.generation)
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

    @property
    def due_at(self) -> float:
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
        self._indices.owners.pop(index, None)


@dataclass(slots=True)
class EchoRequest:
    """An echo request that was sent."""

    session: Session | None
    """On which it was sent; None if that has ended."""
    sent_at: float
    sent: int
    """Envelopes of the session until then, the request included, without questions to candidates."""
    repeats: Repeats
    """Of them, along the best path."""
    is_answered: bool = False


class EchoRequests:
    """The echo requests to one peer, on all its sessions.

    A request older than :data:`c.LATE_AFTER_S` is forgotten: an answer to it is late, however many were sent since.
    Tokens begin at a random one: a request from before a restart, which an attacker held, must not be one of them.
    """

    __slots__ = ("_by_token", "_last", "_last_answered", "was_late")

    def __init__(self, entropy: Entropy) -> None:
        self._last = self._last_answered = int.from_bytes(entropy(4), "big") >> 1
        self._by_token: dict[int, EchoRequest] = {}  # the oldest first
        self.was_late = False
        """Whether the last answer was late: a queue, or an attacker that holds it back."""

    def __len__(self) -> int:
        return len(self._by_token)

    def add(self, session: Session, now: float, sent: int = 0, repeats: Repeats = NO_REPEATS) -> int:
        """The token of a new request."""
        self._last += 1
        token = self._last % 2**32
        self._by_token[token] = EchoRequest(session, now, sent, repeats)
        return token

    @property
    def unanswered(self) -> int:
        """How many were sent since the last one that was answered in time."""
        return self._last - self._last_answered

    def repeat_s(self, pace: Pace) -> float:
        """How long to wait for the answer to the next request. On a network with a budget twice as long each time.

        Else the requests that repeat it fill a network that carries less than its budget.
        """
        if pace is FREE:
            return pace.ask_s
        return max(pace.ask_s, min(pace.ask_s * 2.0 ** min(self.unanswered, 32), pace.hold_s))

    def expire(self, now: float) -> int:
        """Forget the requests that can only be answered late. Returns how many of them were not answered."""
        expired = [token for token, request in self._by_token.items() if request.sent_at < now - c.LATE_AFTER_S]
        return sum(not self._by_token.pop(token).is_answered for token in expired)

    def find(self, token: int) -> EchoRequest | None:
        """The request with this token; None if it is forgotten, or never was sent."""
        return self._by_token.get(token)

    def answer(self, token: int) -> EchoRequest | None:
        """The request that is answered now, in time; None if it was answered before, or :meth:`find` returns None."""
        request = self._by_token.get(token)
        if request is None or request.is_answered:
            return None
        request.is_answered = True
        self.was_late = False
        self._last_answered = max(self._last_answered, token)
        return request

    def forget(self, session: Session) -> None:
        """A session has ended: an answer to a request on it measures the round trip only."""
        for request in self._by_token.values():
            if request.session is session:
                request.session = None

    def is_late(self, token: int) -> bool:
        """Whether a request was sent and forgotten, and no later one was answered in time."""
        return self._last_answered < token <= self._last and token not in self._by_token
