"""One path to a peer: whether it answers, how fast, and how much it loses. README.md, section 15.

Only an answered question makes a path usable. What the peer reports can only make it worse.
"""

from __future__ import annotations

from dataclasses import InitVar, dataclass, field
from enum import StrEnum
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_measures import NO_REPEATS, EnvelopeLimit, PathLoss, Repeats
from uavlinkd.protocol.wire import Probe


class PathCondition(StrEnum):
    """What is known about a path."""

    UNPROVEN = "unproven"
    """No question along it was answered yet."""
    USABLE = "usable"
    SUSPECT = "suspect"
    """It may have failed a moment ago."""
    DOWN = "down"


class Question(NamedTuple):
    """A question that was sent and not answered."""

    sent_at: float
    sent: int
    """Envelopes of the session sent along the path until then, the question included."""
    repeats: Repeats = NO_REPEATS
    size: int = 0
    """The length of its envelope, if that was padded."""


@dataclass(slots=True, eq=False, repr=False)
class PathState:
    """A slot of a :class:`uavlinkd.protocol.paths.PathSet`. It is compared by identity."""

    path: Path
    number: int
    """From 1: names the path in :class:`uavlinkd.protocol.counters.Arrivals`."""
    now: InitVar[float]
    is_configured: bool
    is_metered: bool
    is_stream: bool = False
    """Whether TCP carries it: the last choice, also after metered ones."""
    is_known: bool = False
    """Whether the peer was there: a session was made along it, or it is validated."""
    is_proven: bool = False
    """Whether it may get more bytes than came from there: it is configured, or validated."""
    is_off: bool = False
    """Whether its network is gone: nothing is sent there."""
    is_reported: bool = False
    """Whether it was reported as usable, and not as down since."""
    condition: PathCondition = PathCondition.UNPROVEN
    reason: str = "new"
    """Why: ``answered``, ``unanswered``, ``loss``, ``network``, ``closed`` (a connection of TCP) or ``new``."""
    since: float = 0.0
    """When the condition began."""
    sent: int = 0
    """Envelopes of the current session along this path, copies from other paths too, without repeats."""
    received: int = 0
    """The same of the peer's."""
    repeats: Repeats = NO_REPEATS
    """Of what was sent."""
    datagrams_sent: int = 0
    bytes_sent: int = 0
    datagrams_received: int = 0
    bytes_received: int = 0
    duplicates: int = 0
    """Received copies of envelopes that had arrived already."""
    echo_at: list[float] = field(default_factory=lambda: [-c.NEVER, -c.NEVER])
    """On a network with a budget: when it may carry a copy of an echo request, and of a reply."""
    held_back_s: float = 0.0
    returns_at: float = -c.NEVER
    """When it may become the best path again."""
    received_at: float = -c.NEVER
    """When an envelope arrived first along this path."""
    round_trips: int = 0
    """How many were measured."""
    round_trip_s: float | None = None
    """The last one that was measured. The others are smoothed."""
    srtt_s: float | None = None
    rttvar_s: float | None = None
    loss_by_echo: PathLoss = field(default_factory=PathLoss)
    """As the answers to echo requests say, if it is the only path."""
    envelope_limit: EnvelopeLimit = field(default_factory=EnvelopeLimit)
    answered_at: float = -c.NEVER
    answers: int = 0
    """How many of its questions were answered."""
    questioned_at: float = -c.NEVER
    question_at: float = c.NEVER
    """When the next question is due."""
    copied_question: int = 0
    """The last question that was answered here although it had arrived along another path before."""
    _waiting: dict[int, Question] = field(default_factory=dict)  # the oldest first
    _unanswered_since: float = c.NEVER
    _unanswered: int = 0  # questions since the last answer
    _recovering_since: float = c.NEVER
    _recovering_answers: int = 0
    _loss_in: PathLoss = field(default_factory=PathLoss)
    _loss_out: PathLoss = field(default_factory=PathLoss)
    copy_lag_s: float | None = None
    """How much later than along the first path the last copy arrived; 0 for the first path itself."""
    _reported_lost: int = 0  # of the peer's datagrams of the current session

    def __post_init__(self, now: float) -> None:
        self.is_proven = self.is_configured
        self.since = self.question_at = now

    # Facts.

    @property
    def is_validated(self) -> bool:
        """Whether a question along it was ever answered."""
        return self.answered_at != -c.NEVER

    @property
    def works(self) -> bool:
        """Whether frames may be sent along it: it is usable, or suspect."""
        return self.condition is PathCondition.USABLE or self.condition is PathCondition.SUSPECT

    @property
    def is_silent(self) -> bool:
        """Whether it became suspect because it did not answer, and still is."""
        return self.condition is PathCondition.SUSPECT and self.reason == "unanswered"

    @property
    def is_recovering(self) -> bool:
        """Whether a path that was down answers again."""
        return self._recovering_since != c.NEVER

    @property
    def loss_in(self) -> float:
        """The share of the peer's envelopes that this path lost recently, 0 to 1. A repeated one is lost with all
        its repeats.
        """
        return self._loss_in.share()

    @property
    def loss_out(self) -> float:
        """The share of our datagrams, repeats too, that it lost, as the peer reports."""
        return self._reported_loss.share()

    def recent_losses(self, now: float) -> list[tuple[int, int]]:
        """In and out, how many envelopes were sent in :data:`c.LOSS_WINDOW_S`, and how many were lost.

        Zero where there was no report for two of the usual intervals.
        """
        directions, oldest = (self._loss_in, self._reported_loss), now - 2 * c.PROBE_INTERVAL_S
        return [loss.recent(c.LOSS_WINDOW_S) if loss.reported_at > oldest else (0, 0) for loss in directions]

    def loss_to_repair(self) -> tuple[float, int]:
        """The share of our datagrams that it lost in the last :data:`c.REPAIR_WINDOW_S`, and how many envelopes."""
        loss = self._reported_loss
        return loss.share(c.REPAIR_WINDOW_S), loss.recent(c.REPAIR_WINDOW_S)[1]

    @property
    def _reported_loss(self) -> PathLoss:
        by_echo, by_probe = self.loss_by_echo, self._loss_out
        return by_echo if by_echo.reported_at > by_probe.reported_at else by_probe

    @property
    def wait_s(self) -> float:
        """An answer that takes longer makes the path suspect (RFC 6298, section 2, with a lower least value)."""
        if self.srtt_s is None or self.rttvar_s is None:
            return c.FIRST_ANSWER_S
        return max(c.LEAST_ANSWER_S, self.srtt_s + 4 * self.rttvar_s)

    @property
    def _down_after_s(self) -> float:
        return max(c.DOWN_AFTER_S, 4 * (self.srtt_s or 0.0))

    def allows(self, size: int) -> bool:
        """Whether a datagram of so many bytes may be sent along it.

        An address that is neither configured nor validated gets no more bytes than came from there.
        """
        return self.is_proven or self.bytes_sent + size <= self.bytes_received

    # Datagrams.

    def note_lost_election(self, now: float, *, is_again: bool) -> None:
        """It lost so much that another path is the best now. ``is_again``: soon after it became the best."""
        self.held_back_s = min(c.HELD_BACK_MOST_S, 2 * max(c.BETTER_FOR_S, self.held_back_s)) if is_again else 0.0
        self.returns_at = now + self.held_back_s

    def note_session(self) -> None:
        """Another session carries the traffic: its datagrams are counted from zero."""
        self.sent = self.received = self._reported_lost = 0
        self.repeats = NO_REPEATS
        self.questioned_at = -c.NEVER  # the peer knows no counts of this session yet
        self._loss_in, self._loss_out, self.loss_by_echo = PathLoss(), PathLoss(), PathLoss()
        self._waiting = {token: asked._replace(sent=0) for token, asked in self._waiting.items()}

    def note_sent(self, size: int) -> None:
        """Count a datagram of so many bytes that leaves along this path."""
        self.datagrams_sent += 1
        self.bytes_sent += size

    def note_transmission(self, number: int) -> None:
        """Count an envelope of the current session that leaves along this path for the time with this number."""
        if number == 1:
            self.sent += 1
            return
        at = number - 2
        self.repeats = (*self.repeats[:at], self.repeats[at] + 1, *self.repeats[at + 1 :])

    def head_start_s(self, slower: PathState) -> float:
        """How much earlier than along a slower path the peer's envelopes arrive here, at most, as far as is known.

        Negative if the other path is known to be the faster one.
        """
        by_answers_s = ((slower.srtt_s or 0.0) - (self.srtt_s or 0.0)) / 2
        if slower.copy_lag_s is None or self.copy_lag_s is None:
            return by_answers_s
        return max(slower.copy_lag_s - self.copy_lag_s, by_answers_s)

    # Probes.

    def make_test(self, question: int, size: int, now: float) -> Probe:
        """The record of a probe that is padded to this length; 0: of the short one beside it.

        It may well get no answer. So it makes no path suspect, and a padded one is left out of what was sent.
        """
        self._wait_for(question, Question(now, 0, size=size), now)
        return Probe(question, 0, self.sent + (not size), self.received)

    def take_questions(self, candidate: PathState) -> None:
        """The path was asked as a candidate, before it had a slot: the answers to those questions count."""
        self._waiting = candidate._waiting

    def make_probe(self, question: int, answer: int, now: float) -> Probe:
        """The record to be sent along this path now."""
        if question:
            self.questioned_at = now
            self._wait_for(question, Question(now, self.sent + 1, self.repeats), now)
            if not self._unanswered:
                self._unanswered_since = now
            self._unanswered += 1
        return Probe(question, answer, self.sent + 1, self.received)

    def _wait_for(self, token: int, question: Question, now: float) -> None:
        self._expire_questions(now)
        if len(self._waiting) >= c.QUESTIONS_PER_PATH:
            del self._waiting[next(iter(self._waiting))]
        self._waiting[token] = question

    def receive_report(self, report: Probe, now: float) -> int:
        """The peer's counts, in a probe of the current session.

        Returns how many more of its datagrams are lost than at the last report; 0 if the path did not work since.
        """
        self._loss_in.add(now, report.sent, self.received)
        lost = report.sent - self.received
        more = max(0, lost - self._reported_lost) if self.works else 0
        self._reported_lost = max(lost, self._reported_lost)
        return more

    def receive_answer(self, answer: int, received: int | None, now: float) -> float | None:
        """The round trip of the question that was answered. None if no such question waits here.

        ``received``: how many of our datagrams had arrived then; None if the answer came on an older session.
        """
        self._expire_questions(now)
        asked = self._waiting.get(answer)
        if asked is None:
            return None
        if asked.size:
            self.envelope_limit.acknowledge(asked.size, now)
        del self._waiting[answer]
        # Earlier questions say no more than this one: only the later ones count as unanswered.
        later = [other.sent_at for other in self._waiting.values() if other.sent_at > asked.sent_at and other.sent]
        self._unanswered, self._unanswered_since = len(later), min(later, default=c.NEVER)
        self._note_answered(now)
        self.answers += 1
        round_trip_s = now - asked.sent_at
        if self.answers <= c.SETTLING_ANSWERS and self.srtt_s is not None and round_trip_s < self.srtt_s / 2:
            # A radio that slept answered the waiting questions late. That must not decide an election for long.
            self.srtt_s, self.round_trips = None, 0
        self._add_round_trip(round_trip_s)
        if received is not None and asked.sent:
            self._loss_out.add(asked.sent_at, asked.sent, received, asked.repeats)
            self.envelope_limit.note_lost(self._loss_out.recent(c.SUSPECT_WINDOW_S)[1], now)
        return round_trip_s

    def note_echo(self, round_trip_s: float, now: float) -> None:
        """An echo request along the only path was answered."""
        self._note_answered(now)
        self._add_round_trip(round_trip_s)
        self.envelope_limit.note_lost(self.loss_by_echo.recent(c.SUSPECT_WINDOW_S)[1], now)

    def _note_answered(self, now: float) -> None:
        if not self.is_validated:
            self.envelope_limit.begin(now)
        self.answered_at, self.is_proven = now, True

    def _add_round_trip(self, round_trip_s: float) -> None:
        self.round_trip_s = round_trip_s
        self.round_trips += 1
        if self.srtt_s is None or self.rttvar_s is None:
            self.srtt_s, self.rttvar_s = round_trip_s, round_trip_s / 2
            return
        self.rttvar_s += (abs(self.srtt_s - round_trip_s) - self.rttvar_s) / 4
        # At first the mean: one round trip must not decide an election for many seconds.
        self.srtt_s += (round_trip_s - self.srtt_s) / min(8, self.round_trips)

    def _expire_questions(self, now: float) -> None:
        expired = [token for token, asked in self._waiting.items() if now >= asked.sent_at + c.QUESTION_LIFETIME_S]
        for token in expired:
            del self._waiting[token]

    # The condition.

    def set_off(self, *, is_off: bool, now: float) -> None:
        """Its network disappeared, or appeared or changed: then it has to prove itself at once."""
        self.is_off = is_off
        self._waiting.clear()
        self._unanswered, self._unanswered_since = 0, c.NEVER
        if is_off:
            self._set(PathCondition.DOWN, "closed" if self.is_stream else "network", now)
        self.question_at = c.NEVER if is_off else now
        if not is_off:
            self.questioned_at = -c.NEVER  # ask at once, however recently it was asked
        if not is_off and self.is_validated:
            self.envelope_limit.begin(now)

    def set_usable(self, now: float) -> None:
        """A question was answered, and that is enough."""
        self._set(PathCondition.USABLE, "answered", now)

    def note_answer(self, now: float, *, is_only: bool) -> None:
        """A question was answered. ``is_only``: no other path works, so this one is used at once."""
        if self.condition is PathCondition.DOWN and not is_only:
            if not self.is_recovering:
                self._recovering_since, self._recovering_answers = now, 0
            self._recovering_answers += 1
            if self._recovering_answers < c.RECOVERED_ANSWERS or now < self._recovering_since + c.RECOVERED_AFTER_S:
                return
        sent, lost = self._loss_out.recent(c.SUSPECT_WINDOW_S)
        if sent >= c.SUSPECT_ENVELOPES and lost > c.SUSPECT_LOSS * sent:
            self._set(PathCondition.SUSPECT, "loss", now)
        else:
            self.set_usable(now)

    def check(self, now: float) -> None:
        """Judge what was not answered in time."""
        is_late = now >= self._unanswered_since + self.wait_s
        if is_late and self.is_recovering:
            self._recovering_since = c.NEVER
        if not self.works:
            return
        if self._unanswered >= 2 and now >= self._unanswered_since + self._down_after_s:
            self._set(PathCondition.DOWN, "unanswered", now)
        elif is_late and self.condition is PathCondition.USABLE:
            self._set(PathCondition.SUSPECT, "unanswered", now)

    @property
    def due_at(self) -> float:
        """When :meth:`check` has something to do."""
        if self.condition is PathCondition.USABLE or self.is_recovering:
            return self._unanswered_since + self.wait_s
        if self.condition is PathCondition.SUSPECT and self._unanswered >= 2:
            return self._unanswered_since + self._down_after_s
        return c.NEVER

    def _set(self, condition: PathCondition, reason: str, now: float) -> None:
        self._recovering_since = c.NEVER
        if condition is not self.condition:
            self.condition, self.since = condition, now
        self.reason = reason
