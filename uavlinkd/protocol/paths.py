"""The paths to one peer: which one is best, and along which ones each class of frames goes.

README.md, section 15. The paths share one session. Nothing here sends: :mod:`.probing` does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Final

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.outputs import LinkedPeer, PathChanged, PathEvent, PathStateChanged, PathSuspected
from uavlinkd.protocol.path import FREE, Pace, Path, SocketAddress, SocketFacts
from uavlinkd.protocol.path_measures import Repeats
from uavlinkd.protocol.path_slots import PathSlots, Route
from uavlinkd.protocol.path_state import PathCondition, PathState
from uavlinkd.protocol.settings import Class, Redundancy


class Election:
    """Elects the best path. It remembers which path has been better for how long."""

    __slots__ = ("_better", "_better_since", "_chosen", "_chosen_at")

    def __init__(self) -> None:
        self._better: PathState | None = None
        self._better_since = c.NEVER
        self._chosen: PathState | None = None  # the best path, and since when
        self._chosen_at = -c.NEVER

    @property
    def due_at(self) -> float:
        """When a better path has proved itself; infinity without one."""
        return c.NEVER if self._better is None else self._better_since + c.BETTER_FOR_S

    def elect(self, best: PathState | None, states: Iterable[PathState], now: float) -> tuple[PathState | None, str]:
        """The best of these paths, and why it is another one than ``best``.

        A path that failed stays the best while there is no other.
        """
        if best is not self._chosen:  # a session was made elsewhere, or its slot is gone
            self._chosen, self._chosen_at = best, now
        elected, reason = self._elect(best, states, now)
        if elected is not best:
            self._chosen, self._chosen_at, self._better = elected, now, None
        return elected, reason

    def _elect(self, best: PathState | None, states: Iterable[PathState], now: float) -> tuple[PathState | None, str]:
        working = [state for state in states if state.works]
        datagrams = [state for state in working if not state.is_stream]
        pool = [state for state in datagrams if not state.is_metered] or datagrams or working
        usable = [state for state in pool if state.condition is PathCondition.USABLE]
        if best is None or best not in pool:
            self._better = None
            if not pool:
                return best, ""
            elected = min(usable or pool, key=_cost)
            if best is None or not best.works:
                return elected, "first" if best is None else best.reason
            return elected, "udp" if best.is_stream else "metered"
        rivals = [state for state in usable if state is not best and now >= state.returns_at]
        if best.path.is_relayed and (direct := [state for state in rivals if not state.path.is_relayed]):
            elected = min(direct, key=_cost)
            if _better_than(elected, [best]) is None:
                return elected, "direct"
        rival = _better_than(best, rivals) if rivals else None
        if rival is None or rival is not self._better:
            self._better, self._better_since = rival, now
        if rival is None or now < self.due_at:
            return best, ""
        if best.loss_out < c.SUSPECT_LOSS:
            return rival, "faster"
        # A path that loses only what the best path carries would be elected again and again.
        best.note_lost_election(now, is_again=now < self._chosen_at + c.HELD_BACK_MOST_S)
        return rival, "loss"


def _better_than(best: PathState, rivals: list[PathState]) -> PathState | None:
    """The best of the rivals, if its cost is lower by enough."""
    rival = min(rivals, key=_cost)
    old, new = _cost(best), _cost(rival)
    return rival if new <= (1 - c.BETTER_SHARE) * old and new <= old - c.BETTER_BY_S else None


def _cost(state: PathState) -> float:
    """What is compared, in seconds: half of the round trip, and a penalty for loss."""
    return (state.srtt_s or 0.0) / 2 + c.LOSS_PENALTY_S * state.loss_out


_NO_ROUTES: Final[Mapping[Class, Route]] = dict.fromkeys(Class, ())


class PathSet(PathSlots):
    """The paths to one peer."""

    def __init__(
        self,
        redundancy: Redundancy,
        idle_probe_s: float,
        known: Counter[SocketAddress],
        facts: SocketFacts,
    ) -> None:
        super().__init__(known, facts)
        self._redundancy = redundancy
        self._idle_probe_s = idle_probe_s
        self._election = Election()
        self._reported_best: PathState | None = None
        self.revised_at = c.NEVER
        """Slots or networks have changed: :meth:`update` is due since then, also while the peer is not up."""
        self.slots_at = c.NEVER
        """When a slot is given up: the same."""
        self.has_relayed = False
        """Whether one of them led through a relay, now or before."""
        self.reports_single = False
        """Whether the condition of a path is reported even if it is the only one."""
        self.is_multiple = False
        """Whether the class of a frame matters: it decides about its paths, or about a relay's next handle."""
        self.routes = _NO_ROUTES
        """The paths of each class; all empty before a path is known."""
        self.shares_envelopes = False
        """Whether several frames were ever sent together. Before that no long envelope is needed."""
        self.longest: Mapping[Class, int] = dict.fromkeys(Class, c.MIN_ENVELOPE_LIMIT)
        """The longest envelope that frames of each class share, in bytes. A longer one holds a single frame."""
        self.due_at = c.NEVER
        """When :meth:`update` has something to do, or a question is due."""
        self.active_at = -c.NEVER
        """When frames were sent last."""
        self.searched_at = -c.NEVER
        """When a candidate was asked last."""
        self.stream_at = -c.NEVER
        """When the best path carried a stream last."""
        self._stream_times = [-c.NEVER] * c.STREAM_ENVELOPES  # of the last envelopes, the oldest first

    # Facts.

    @property
    def works(self) -> bool:
        """Whether frames may be sent along the best path."""
        return self.best is not None and self.best.works

    @property
    def round_trip_s(self) -> float:
        """The mean round trip of the best path, if that works: at most `LATE_AFTER_S`, 0 before the first answer.

        An attacker that slows the path must not lengthen waits without bound.
        """
        best = self.best
        return 0.0 if best is None or best.srtt_s is None or not best.works else min(best.srtt_s, c.LATE_AFTER_S)

    @property
    def echo_route(self) -> Route:
        """Of echo requests that are repeated if they are lost, and of their replies."""
        is_usable = self.best is not None and self.best.condition is PathCondition.USABLE
        return self.routes[Class.BULK if is_usable else Class.CRITICAL]

    @property
    def pace(self) -> Pace:
        """That of the best path's network."""
        return FREE if self.best is None else self.facts.pace(self.best.path)

    def role(self, state: PathState) -> str:
        """What the path is used for: ``best``, ``metered`` (or by TCP), or ``standby``."""
        return "best" if state is self.best else "metered" if state.is_metered else "standby"

    def handshake_paths(self, *, is_answering: bool = True) -> list[Path]:
        """Where to initiate: every path that may lead to the peer, the best first, and metered ones last.

        While another path works, a metered one is only probed. ``is_answering``: the peer is not silent. Of a silent
        one it is unknown which paths work.
        """
        works = is_answering and any(state.works and not state.is_metered for state in self.by_path.values())
        states = [
            state
            for state in self.by_path.values()
            if (state.is_configured or state.is_validated or state is self.best)
            and not state.is_off
            and not (works and state.is_metered)
        ]
        return [state.path for state in sorted(states, key=lambda state: (state is not self.best, state.is_metered))]

    def _drop(self, state: PathState) -> None:
        """A slot is free: frames that are sent before the next :meth:`update` do not go there any more."""
        super()._drop(state)
        self.routes = {cls: tuple(one for one in route if one is not state) for cls, route in self.routes.items()}

    # Answers.

    def note_answer(self, state: PathState, now: float) -> None:
        """A question along this path was answered."""
        self._note_known(state)
        is_only = not any(other.works for other in self.by_path.values() if other is not state)
        state.note_answer(now, is_only=is_only)

    def note_echo(self, round_trip_s: float, now: float) -> None:
        """An echo request was answered. If there is one path, the request was a question along it."""
        if self.best is not None and len(self.by_path) == 1:
            self.best.note_echo(round_trip_s, now)
            self.note_answer(self.best, now)
            if (self.reports_single and not self.best.is_reported) or now >= self.test_at(self.best):
                self.revise(now)

    def note_echo_counts(self, asked_at: float, sent: int, repeats: Repeats, received: int) -> None:
        """Of ``sent`` envelopes of the session until an echo request so many arrived: the loss of the only path."""
        if self.best is not None and len(self.by_path) == 1:
            self.best.loss_by_echo.add(asked_at, sent, received, repeats)

    # The election.

    def prefer(self, path: Path, now: float) -> PathState:
        """A session was made along this path. It carries traffic if none that works does."""
        state = self.by_path.get(path) or self.learn(path, now)
        if self.best is None or not self.best.works:
            self.best = state
            state.is_proven = True  # for FIRST_PATH_S: without an answer it gives up its slot then
            if state.condition is PathCondition.UNPROVEN:
                state.since = now  # the slot may be from before a silence
        self._note_known(state)
        return state

    def update(self, peer: LinkedPeer, now: float) -> list[PathEvent]:
        """Judge every path, elect the best one, and set the routes and the next deadline. Returns what changed."""
        self.revised_at = c.NEVER
        usable = [state for state in self.states if state.condition is PathCondition.USABLE]
        for state in self.states:
            state.check(now)
        failed = [state for state in usable if state.condition is not PathCondition.USABLE]
        # A NAT that forgot a direct path has forgotten the relay too, which is probed rarely.
        sockets = {state.path.socket for state in failed if not state.path.is_relayed}
        beside = [state for state in usable if state.path.socket in sockets]
        changes: list[PathEvent] = [
            PathSuspected(peer, state.path)
            for state in self.states
            if state.path.is_relayed and (state.is_silent or state in failed or state in beside)
        ]
        if not any(state.works for state in self.by_path.values()):
            for state in self.by_path.values():
                if state.is_recovering:  # the only one to answer: it need not prove itself for longer
                    state.set_usable(now)
        self.best, reason = self._election.elect(self.best, self.by_path.values(), now)
        for state in self.by_path.values() if self.has_several or self.reports_single else ():
            is_usable = state.condition is PathCondition.USABLE
            if is_usable and not state.is_reported:
                state.is_reported = True
                changes.append(PathStateChanged(peer, state.path, True, state.reason))
            elif state.condition is PathCondition.DOWN and state.is_reported:
                state.is_reported = False
                changes.append(PathStateChanged(peer, state.path, False, state.reason))
        for state in self.states:
            if now >= self._gone_at(state):
                self.remove(state)
        before, self._reported_best = self._reported_best, self.best
        if self.best is not None and before is not None and self.best is not before:
            changes.insert(0, PathChanged(peer, self.best.path, before.path, reason or "session"))
            # The next frames of the stream have a question in front: it shows the peer where they go now.
            self.best.questioned_at = now + c.QUESTION_EARLY_S - self.interval_s(self.best, now)
        self._set_routes(now)
        self.schedule(now)
        return changes

    def _gone_at(self, state: PathState) -> float:
        """When a path gives up its slot; infinity for one that is configured, works, or is the best."""
        if state.is_configured:
            return c.NEVER
        if state.condition is PathCondition.UNPROVEN:
            return state.since + (c.FIRST_PATH_S if state is self.best else c.QUESTION_LIFETIME_S)
        if state.works or state is self.best:
            return c.NEVER
        return max(state.since, state.answered_at) + c.FORMER_PATH_S  # at 50 % loss a path answers, but stays down

    def _set_routes(self, now: float) -> None:
        best, self.outlet = self.best, None
        if best is None:
            self.routes, self.is_multiple = _NO_ROUTES, self.has_relayed
            return
        others = [
            state for state in self.by_path.values() if state is not best and state.is_validated and not state.is_off
        ]
        relayed = [state for state in self.by_path.values() if state.path.is_relayed]
        if relayed:
            self.has_relayed = True
            others = self._without_spares(best, others)
        # Also with one path along a relay: the next one carries recent critical envelopes again.
        self.is_multiple = bool(others or relayed)
        alone = (best,)
        critical = alone if self._redundancy is Redundancy.NONE else (best, *others)
        stream: Route = alone
        if self._redundancy is Redundancy.ALL:
            stream = (best, *(state for state in others if state.works and not state.is_metered))
        elif best.condition is not PathCondition.USABLE:
            is_late = best.reason != "loss"
            answering = [state for state in others if state.works or state.is_recovering]
            stream = (best, *(state for state in answering if is_late or not state.is_metered))
        self.routes = {Class.CRITICAL: critical, Class.STREAM: stream, Class.BULK: alone}
        self.longest = {cls: self._longest(route, cls) for cls, route in self.routes.items()}

    def _without_spares(self, best: PathState, others: list[PathState]) -> list[PathState]:
        """Without the relayed paths that carry no copies: better paths from the same socket do.

        One failure, of a relay or of a network at either end, leaves a path with copies. Two handles of one relay
        lead to two networks of the peer. Where those of different relays lead is not known.
        """
        usable = [state.path for state in self.by_path.values() if state.condition is PathCondition.USABLE]
        direct = Counter(path.socket for path in usable if not path.is_relayed)
        carrying: dict[int, Counter[str]] = {}  # by socket, how many through each relay
        picked = [state for state in others if not state.path.is_relayed]
        others.sort(
            key=lambda state: (state.condition is not PathCondition.USABLE, not state.works, state.srtt_s or c.NEVER)
        )
        for state in (best, *others):
            if not state.path.is_relayed:
                continue
            socket, relay = state.path.socket, state.path.host
            relays = carrying.setdefault(socket, Counter())
            is_full = relays.total() >= max(1, c.COPIES_PER_SOCKET - direct[socket])
            is_further = relay not in relays and len(relays) >= (1 if direct[socket] else c.RELAYED_COPIES)
            if is_full or is_further or relays[relay] >= c.RELAYED_COPIES:
                continue
            relays[relay] += 1
            if state is not best:
                picked.append(state)
        return picked

    # Lengths of envelopes.

    def _longest(self, route: Route, cls: Class) -> int:
        if cls is Class.CRITICAL and len(route) > 1:  # bit-identical copies along the whole route
            return min(c.CRITICAL_ENVELOPE_LIMIT, *(self.network_limit(state) for state in route))
        return min(route[0].envelope_limit.limit, self.network_limit(route[0]))

    def test_at(self, state: PathState) -> float:
        """When to test how long the envelopes of a path may be."""
        is_due = self.shares_envelopes and state.condition is PathCondition.USABLE
        return state.envelope_limit.due_at if is_due else c.NEVER

    # Deadlines.

    def revise(self, now: float) -> None:
        """Slots or networks have changed: :meth:`update` is due, also if frames are sent before it."""
        self.revised_at = self.due_at = now

    def is_idle(self, now: float) -> bool:
        """Whether no frames were sent recently."""
        return now > self.active_at + c.IDLE_AFTER_S

    def note_stream(self, now: float) -> bool:
        """Frames are sent. Returns whether the best path begins to carry a stream now.

        It carries one only with enough envelopes a second: questions four times a second would cost more than a rare
        frame is worth.
        """
        self._stream_times.append(now)
        if now >= self._stream_times.pop(0) + c.STREAM_ENDS_AFTER_S:
            return False
        begins = now >= self.stream_at + c.STREAM_ENDS_AFTER_S
        self.stream_at = now
        return begins

    def interval_s(self, state: PathState, now: float) -> float:
        """How long after a question the next one along this path is due; infinity for none."""
        return max(self.facts.least_probe_s(state.path), self._wanted_interval_s(state, now))

    def _wanted_interval_s(self, state: PathState, now: float) -> float:
        """The same, without regard to budgets."""
        others = [other for other in self.by_path.values() if other is not state]
        is_needed = state is self.best or not any(other.works for other in others)
        if state.is_metered and not is_needed:
            return self._idle_probe_s or c.NEVER
        if state.condition is PathCondition.SUSPECT or state.is_recovering:
            return c.PROBE_FAST_S
        if not state.works:
            age_s = now - state.since
            if state.is_configured and not others and state.condition is PathCondition.UNPROVEN:
                return c.PROBE_DOWN_S  # echo requests ask too
            if age_s < c.DOWN_AFTER_S or (state is self.best and state.condition is PathCondition.UNPROVEN):
                return c.PROBE_FAST_S
            return c.PROBE_DOWN_S if age_s < c.LONG_DOWN_S else c.PROBE_LONG_DOWN_S
        if not others or self.is_idle(now):
            if state is self.best and now < self.searched_at + c.CANDIDATE_ROUND_MOST_S:
                return c.PROBE_INTERVAL_S
            return (self._idle_probe_s if others else 0) or c.NEVER  # echo requests ask along a path without others
        if state.answers < c.SETTLING_ANSWERS:
            return c.PROBE_FAST_S
        if not any(other.works or other.is_recovering for other in others):
            return c.PROBE_INTERVAL_S
        carries_stream = state is self.best and now < self.stream_at + c.STREAM_ENDS_AFTER_S
        return c.PROBE_FAST_S if carries_stream else c.PROBE_STANDBY_S

    def schedule(self, now: float) -> None:
        """Set the next deadline: a question, a judgement, or a better path that has proved itself."""
        self.slots_at = min(map(self._gone_at, self.by_path.values()), default=c.NEVER)
        moments = [self.revised_at, self._election.due_at, self.slots_at]
        for state in self.by_path.values():
            interval_s = c.NEVER if state.is_off else self.interval_s(state, now)
            state.question_at = c.NEVER if interval_s == c.NEVER else max(now, state.questioned_at + interval_s)
            moments += [state.question_at, state.due_at, self.test_at(state)]
        self.due_at = min(moments)
