"""The state of the link with one peer: its keys, its paths, its frames, and its liveness.

Functions change it, in modules by topic: :mod:`.send`, :mod:`.receive`, :mod:`.freshness`, :mod:`.establish`,
:mod:`.probing` and :mod:`.timeouts`. Each function returns what the shell has to do.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import Entropy, KeyPair
from uavlinkd.protocol.drops import Detail, DropReason
from uavlinkd.protocol.early import EarlyFrames
from uavlinkd.protocol.initiator import Initiator, Pending
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.outputs import Dropped, Output, PeerLost, PeerUp
from uavlinkd.protocol.path import Path, SocketAddress, SocketFacts
from uavlinkd.protocol.path_measures import MissingEnvelopes
from uavlinkd.protocol.paths import PathSet
from uavlinkd.protocol.reports import Claims, OwnReports
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.sessions import EchoRequests, Indices, Sessions
from uavlinkd.protocol.settings import PeerSettings, Screen
from uavlinkd.protocol.timers import Timer, TimerTable


@dataclass(slots=True)
class Traffic:
    """Counters that only grow, as long as the daemon runs."""

    bytes_elsewhere: int = 0
    """Of responses to addresses where the peer is not known to be. An attacker that replays its handshakes causes
    them, so the totals of paths, which a link's budget pays for, do not include them."""
    sealed: int = 0
    """Envelopes to the peer, of sessions that have ended."""
    opened: int = 0
    """Envelopes of the peer that were accepted, of sessions that have ended."""
    handshakes: int = 0
    drops: Counter[DropReason] = field(default_factory=Counter)
    missing: int = 0
    """Envelopes of sessions that have ended, sent by the peer and never accepted here."""
    out_of_order: int = 0
    """Envelopes accepted after one that was sent later."""
    echoes_unanswered: int = 0
    """Own echo requests without an answer in time."""
    handshakes_unanswered: int = 0
    """Initiations on a link that is up, without a response before the next try."""
    cookies_taken: int = 0
    """Cookies of a peer under load. An attacker that knows both public keys can make them too."""
    reported: tuple[int, int] = (0, 0)
    """Of the current session, as the peer last reported: envelopes expected there, and received."""


class Shared(NamedTuple):
    """What all peers of a node have in common."""

    indices: Indices[tuple[Peer, Session | Pending]]
    entropy: Entropy
    screen: Screen
    known: Counter[SocketAddress]
    """How many peers proved to be at an address."""
    facts: SocketFacts


class Peer:
    """The link with one peer. It is compared by identity; its parts do not refer to it."""

    __slots__ = (
        *("answers", "asked_at", "candidate_questions", "claims", "cookied_answers", "durations"),
        *("early", "echo_after_s", "echo_at", "echo_requests", "entropy", "established_at", "group_work"),
        *("handshake_after_s", "handshake_s", "hinted_at", "indices", "initiator", "is_up", "losses"),
        *("lost_after_s", "name", "offered_at", "paths"),
        *("proven_group_work", "provisional_until", "received_at", "recent", "remembered", "reports"),
        *("round_trip_s", "screen", "sent_at", "sessions", "settings", "silence_s", "timers", "traffic"),
        *("unanswered_since", "unverified_since", "verify_interval_s", "__weakref__"),
    )

    def __init__(self, settings: PeerSettings, identity: KeyPair, shared: Shared, now: float) -> None:
        self.settings = settings
        self.name = settings.name
        self.durations = timers = settings.link.timers
        self.traffic = Traffic()
        self.reports = OwnReports()
        self.claims = Claims()

        # Keys.
        self.indices = shared.indices
        self.entropy = shared.entropy
        self.initiator = Initiator(settings, identity, shared.indices, shared.entropy, shared.facts, now)
        self.sessions = Sessions(shared.indices, self.name, has_smaller_key=identity.public < settings.public_key)
        self.established_at: float | None = None
        self.offered_at = -c.NEVER
        """When the features changed that this side offers."""
        self.provisional_until = c.NEVER
        """When it is removed: until its first envelope, if it is known by a certificate that it showed."""
        self.hinted_at = -c.NEVER
        self.remembered: deque[bytes] = deque()
        """Ephemerals of its initiations, the oldest first."""
        self.answers = TokenBucket(*c.ANSWERS, now)
        """Responses that it may get without a cookie."""
        self.cookied_answers = TokenBucket(c.COOKIED_ANSWERS_PER_S, c.COOKIED_ANSWERS_PER_S, now)
        """Responses that it may get with cookies, at all addresses together."""
        self.group_work = TokenBucket(*c.GROUP_WORK_PER_PEER, now)
        """CPU time for the groups of its suites that it may cause from anywhere."""
        self.proven_group_work = TokenBucket(*c.GROUP_WORK_PER_PEER, now)
        """CPU time that it may cause in addition where it proves to be at its own address."""

        # Paths.
        self.paths = PathSet(settings.link.redundancy, settings.link.idle_probe_s, shared.known, shared.facts)
        """Where the peer is, or may be."""
        self.paths.reports_single = bool(settings.link.features & c.FEATURE_RECORDS)
        self.losses = MissingEnvelopes()
        self.candidate_questions = TokenBucket(c.CANDIDATE_QUESTIONS_PER_S, c.CANDIDATE_QUESTIONS, now)
        """Questions to addresses that it named and that never answered."""

        # Frames.
        self.screen = shared.screen
        """Tells frames that may be old from those that must be new."""
        self.verify_interval_s = settings.link.verify_interval_s
        """How often freshness is verified in the sessions that are made from now on."""
        self.unverified_since: float | None = None
        """Since when frames that must be new are held, because no answers arrive; None while they are verified."""
        self.early: EarlyFrames | None = None
        """Its frames that wait for others along a slower path; None before it has several paths."""
        self.recent: list[tuple[float, bytes]] = []
        """Critical envelopes, and when they were sent, if a path leads through a relay: a new path may carry them."""

        # Liveness.
        self.timers = TimerTable()
        self.is_up = False
        self.received_at: float | None = None
        """When an envelope or response that is known to be new arrived last."""
        self.sent_at = now
        """When an envelope was sent last."""
        self.unanswered_since: float | None = None
        """When the first envelope was sent since one was received; None if none was."""
        self.echo_requests = EchoRequests(shared.entropy)
        self.asked_at = -c.NEVER
        """When an echo request was sent last."""
        self.echo_at = c.NEVER
        """Ask for an echo then, if still nothing was received."""
        self.round_trip_s: float | None = None
        self.handshake_s = 0.0
        """How long the last response took; 0 after a question was answered since."""
        self.silence_s = min(timers.echo_after_s, timers.handshake_after_s, timers.lost_after_s)
        """A silence is acted on after this, or later."""
        self.set_waits()

    @property
    def path(self) -> Path | None:
        """The best path: the stream goes there."""
        return None if self.paths.best is None else self.paths.best.path

    @property
    def envelopes_sent(self) -> int:
        """Envelopes to the peer on all sessions so far."""
        return self.traffic.sealed + sum(session.send_counter for session in self.sessions.confirmed)

    @property
    def envelopes_received(self) -> int:
        """Envelopes of the peer that were accepted, on all sessions so far."""
        return self.traffic.opened + sum(session.received for session in self.sessions.confirmed)

    def missing(self, now: float) -> int:
        """Envelopes that the peer sent and that were not accepted, on all sessions so far; it only grows.

        Probes along paths that are down do not count. Call it about once a second.
        """
        gaps = self.traffic.missing + sum(session.missing(now) for session in self.sessions.confirmed)
        return self.losses.count(gaps, now)

    def sending_session(self) -> Session | None:
        """The current session, if it can still seal."""
        session = self.sessions.current
        return None if session is None or session.send_counter >= c.SESSION_ENVELOPE_LIMIT else session

    def session_with(self, feature: int, now: float) -> Session | None:
        """The current session, if both ends have this feature and the keys may still seal."""
        session = self.sessions.current
        if session is None or not session.is_usable(now) or not session.parameters.features & feature:
            return None
        return session

    # Outputs.

    def drop(self, reason: DropReason, count: int) -> list[Output]:
        """Count outgoing frames that are dropped, or envelopes that were held."""
        if not count:
            return []
        self.traffic.drops[reason] += count
        return [Dropped(reason, self, None, count)]

    def drop_datagram(self, reason: DropReason, path: Path, detail: Detail = "") -> Dropped:
        """Count a datagram of this peer, or of a sender that claims to be this peer."""
        self.traffic.drops[reason] += 1
        return Dropped(reason, self, path, 1, detail)

    def note_received(self, now: float) -> list[Output]:
        """Something authentic and new came from the peer."""
        self.received_at = now
        self.unanswered_since = None
        if self.is_up:
            return []
        self.is_up = True
        self.set_paths_timer()
        return [PeerUp(self)]

    def note_lost(self, now: float) -> list[Output]:
        """The peer is silent, or has no session any more."""
        self.is_up = False
        self.unverified_since = None
        assert self.received_at is not None, "a peer is up because something was received"
        return [PeerLost(self, now - self.received_at)]

    # Deadlines that several events change.

    def keys_wanted_at(self) -> float:
        """When new keys are wanted: at once without a session; else by count, by age, or by silence."""
        if not self.paths.by_path or not self.settings.initiates:
            return c.NEVER
        session = self.sessions.current
        if session is None or session.send_counter >= c.REKEY_AFTER_ENVELOPES or session.created_at < self.offered_at:
            return -c.NEVER
        durations = self.durations
        wanted_at = session.created_at + durations.rekey_after_s
        if not session.is_initiator:
            # The initiator goes first, so that in the ordinary case one side rekeys, not both.
            wanted_at += c.RESPONDER_REKEY_SHARE * (durations.reject_after_s - durations.rekey_after_s)
        if self.unanswered_since is None:
            return wanted_at
        return min(wanted_at, self.unanswered_since + self.handshake_after_s)

    @property
    def answer_s(self) -> float:
        """How long an answer takes, as far as is known: at most ``LATE_AFTER_S``."""
        return max(self.paths.round_trip_s, self.handshake_s)

    def set_waits(self) -> None:
        """Set what a silence causes, and after how long: the configured durations, longer on a slow path."""
        durations, round_trip_s = self.durations, self.answer_s
        self.echo_after_s = max(durations.echo_after_s, c.ECHO_ROUND_TRIPS * round_trip_s)
        self.handshake_after_s = max(durations.handshake_after_s, c.HANDSHAKE_ROUND_TRIPS * round_trip_s)
        self.lost_after_s = max(durations.lost_after_s, c.LOST_ROUND_TRIPS * round_trip_s)

    def set_expiry(self) -> None:
        """Set when a session, an initiation or a provisional peer expires."""
        expiries = self.sessions.due_at, self.initiator.due_at, self.provisional_until
        self.timers.set(Timer.EXPIRY, min(expiries))

    def set_initiate(self) -> None:
        """Set when to initiate."""
        self.timers.set(Timer.INITIATE, max(self.initiator.retry_at, self.keys_wanted_at()))

    def set_paths_timer(self) -> None:
        """Set when paths are judged or questioned. A peer that is not up is looked for by handshakes instead."""
        is_probed = self.is_up and self.sending_session() is not None
        self.timers.set(
            Timer.PATHS, self.paths.due_at if is_probed else min(self.paths.revised_at, self.paths.slots_at)
        )

    def new_question(self) -> int:
        """An unpredictable question, which is not 0."""
        return int.from_bytes(self.entropy(c.QUESTION_BYTES), "big") or 1

    def set_freshness(self) -> None:
        """Set when a session has to ask the peer again, or to drop frames that it holds."""
        moments = (min(session.held.due_at, session.verification.due_at) for session in self.sessions.confirmed)
        early_at = c.NEVER if self.early is None else self.early.due_at
        self.timers.set(Timer.FRESHNESS, min(early_at, min(moments, default=c.NEVER)))
