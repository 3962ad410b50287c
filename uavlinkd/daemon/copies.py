"""Sealed datagrams that a peer gets beside the first one of each envelope: copies for other paths, and repeats.

A critical envelope goes along every proven path. The first path carries it at once. Each further one carries a copy.
On lossy paths critical envelopes are repeated too. Specification, section 15. Neither must take a slow network from
the frames that it alone carries. So the copies of a peer use at most the rate of its stream, or 64 kbit/s if that is
more; repeats use what is left of it on average. Of a network's budget the copies of all peers use at most half.

One queue has what waits: copies for which there is no room, and envelopes until they were sent often enough. Copies
go before repeats; then commands and heartbeats, other events, states. Newer states replace older ones that have no
other frames. What waited for :data:`MAX_WAIT_S` is dropped: it has arrived along another path, or comes again. A copy
of an envelope that is not critical does not wait. Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Mapping, Sequence
from math import ceil, inf, log, prod
from typing import Final

from uavlinkd.daemon.journal import ShellReason
from uavlinkd.daemon.networks import LARGEST_BYTES, NetworkBudget, wire_bytes
from uavlinkd.mavlink.dialect import Lane
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.constants import TRANSMISSIONS
from uavlinkd.protocol.path_slots import Route
from uavlinkd.protocol.path_state import PathCondition, PathState

MAX_WAIT_S: Final = 0.5
"""What waits longer is dropped."""
DEBT_S: Final = 0.25
"""A copy is sent at once on a network whose budget is in debt by less than this."""
LEAST_BITS_S: Final = 64_000
"""What the copies of a peer may use at least, as far as networks allow it."""
AVERAGE_S: Final = 10
"""Repeats keep the rate on average over this time, so that a transfer of parameters may use what was not used before
it. On a network or for a peer with a budget this does not count."""
MAX_WAITING_BYTES: Final = 8192
"""Of the copies that wait for one path. The least important ones are dropped first, of these the oldest."""
MAX_ENVELOPES: Final = 256
"""Of one peer that wait for repeats. The same are dropped first."""
SPACING_S: Final = 0.005
"""From an envelope to its first repeat; then each time twice as long. So a state that is sent at 50/s is repeated too
before a newer one replaces it, and a burst of losses does not hit every repeat."""
_SLACK_BYTES: Final = 0.5  # a deadline computed in floating point must not come a hair early, over and over

BEGIN_LOSS: Final = 0.02
"""Repair begins above this loss of all paths together,"""
END_LOSS: Final = 0.01
"""and ends below this one."""
RESIDUAL_LOSS: Final = 0.005
"""Envelopes are repeated so often that less than this share of them is lost, if losses are random."""
LEAST_LOST: Final = 3
"""A path must lose so many envelopes before repair begins: fewer say nothing."""
HOLD_S: Final = 10.0
"""The highest loss of this time decides, so that repair does not flap."""
KNOWN_S: Final = 30.0
"""A path that does not answer is considered for this time: at 70 % loss in each direction, answers are rare."""


class _Waiting:
    """A sealed datagram that waits: a copy for one path, or an envelope that is sent again along its paths."""

    def __init__(
        self, datagram: bytes, paths: Sequence[PathState], frames: Sequence[Frame], last: int, now: float
    ) -> None:
        self.datagram = datagram
        self.paths = paths
        self.number = min(last, 2)
        """Of the next transmission along each path."""
        self.last = last
        self.is_copy = last == 1
        """Whether it waits for its first transmission."""
        self.put_at = now
        self.due_at = now if last == 1 else now + SPACING_S
        kinds = [frame.header.kind for frame in frames]
        self.is_replaceable = all(kind.is_state for kind in kinds)
        self.states: set[FlowKey] = {flow_key(frame) for frame in frames if frame.header.kind.is_state}
        self.rank = min(map(_rank_of, frames))


def _rank_of(frame: Frame) -> int:
    """The importance of a frame, 0 the highest."""
    kind = frame.header.kind
    if kind.lane is Lane.URGENT and (not kind.is_state or kind.may_be_old):  # a command or a heartbeat
        return 0
    return 2 if kind.is_state else 1


class Copies:
    """The copies and repeats for one peer. ``budgets``: by the number of the socket, of networks with a budget."""

    def __init__(self, budgets: Mapping[int, NetworkBudget], now: float) -> None:
        self.dropped: Counter[ShellReason] = Counter()
        """Copies and envelopes that were not sent, or not sent as often as they should, by reason."""
        self.repeats_sent = self.repeat_bytes = 0
        """Repeats so far, and their bytes with IP and UDP headers."""
        self._budgets = budgets
        self._rate = Bucket(LEAST_BITS_S, now, LARGEST_BYTES)
        self._average = Bucket(LEAST_BITS_S, now, AVERAGE_S * LEAST_BITS_S / 8)  # of copies and repeats
        self.waiting: list[_Waiting] = []
        """Copies and repeats, the oldest first."""

    @property
    def count(self) -> int:
        """How many copies wait."""
        return sum(one.is_copy for one in self.waiting)

    def set_stream_rate(self, bytes_s: float, now: float, most_bytes_s: float = inf) -> None:
        """Copies may use as much as the stream of this peer, which has so many bytes a second.

        ``most_bytes_s``: a part of the peer's own budget, if it has one.
        """
        rate = min(most_bytes_s, max(LEAST_BITS_S / 8, bytes_s))
        self._rate.set_rate(rate, now)
        self._average.set_rate(rate, now)
        self._average.set_least_burst(AVERAGE_S * rate if most_bytes_s == inf else LARGEST_BYTES)

    def divide(self, route: Route, now: float) -> tuple[Route, list[PathState]]:
        """Divide a route: the paths along which the next envelope leaves now, and those for which it has to wait."""
        leaving: list[PathState] = []
        later: list[PathState] = []
        for path in route:
            is_next = not leaving or not any(one.is_copy and path in one.paths for one in self.waiting)
            has_room = is_next and self._has_room(path, now, self._rate if leaving else None)
            (leaving if has_room else later).append(path)
        # If no network has room, although one had when the frames were taken, the best path pays with debt.
        return (tuple(leaving), later) if leaving else (route[:1], later[1:])

    def add(
        self,
        datagram: bytes,
        along: Route,
        later: Sequence[PathState],
        frames: Sequence[Frame] | None,
        transmissions: int,
        now: float,
    ) -> None:
        """Charge the copies of an envelope that leaves now. It waits for ``later`` paths, and for its repeats.

        ``frames``: those in the envelope, if it is critical; None for another class, whose copies do not wait.
        """
        for path in along[1:]:
            self._charge(datagram, path, now, self._rate)
        if frames is None:
            self.dropped[ShellReason.COPY_OVER_BUDGET] += len(later)
            return
        for path in later:
            self._put(_Waiting(datagram, (path,), frames, 1, now))
        if transmissions > 1:
            self._put(_Waiting(datagram, along, frames, transmissions, now))

    def release(
        self, usable: Container[PathState], unrepeated: Container[PathState], now: float
    ) -> list[tuple[PathState, bytes, int]]:
        """What is due and has room, each with its number along its path: 1 for a copy, from 2 for repeats.

        What waited too long is dropped, and copies for a path that is not ``usable`` any more. Repeats do not go
        along ``unrepeated`` paths.
        """
        for one in self.waiting:
            one.paths = [path for path in one.paths if path in usable and (one.is_copy or path not in unrepeated)]
        gone = [one for one in self.waiting if now >= one.put_at + MAX_WAIT_S or (one.is_copy and not one.paths)]
        self._drop(gone, ShellReason.COPY_OVER_BUDGET)
        released: list[tuple[PathState, bytes, int]] = []
        blocked: set[PathState] = set()  # copies wait for these, and go before repeats
        due = [one for one in self.waiting if one.due_at <= now]
        for one in sorted(due, key=lambda one: (not one.is_copy, one.rank, one.number)):
            number, rate = one.number, self._rate if one.is_copy else self._average
            for path in one.paths:
                if path in blocked or not self._has_room(path, now, rate):
                    if one.is_copy:
                        blocked.add(path)
                    continue
                size = self._charge(one.datagram, path, now, rate)
                if number > 1:
                    self.repeats_sent += 1
                    self.repeat_bytes += size
                released.append((path, one.datagram, number))
                one.number = number + 1
                one.due_at = now + SPACING_S * 2 ** (number - 1)
        self.waiting = [one for one in self.waiting if one.number <= one.last and one.paths]
        return released

    def next_deadline(self, now: float) -> float:
        """When :meth:`release` has something to do; infinity while nothing waits."""
        at = inf
        of_copies = {path for one in self.waiting if one.is_copy for path in one.paths}
        for one in self.waiting:
            rates = ((path, self._rate if path in of_copies else self._average) for path in one.paths)
            room_at = now + min(self._wait_s(path, now, rate) for path, rate in rates)
            at = min(at, max(one.due_at, room_at), one.put_at + MAX_WAIT_S)
        return at

    def clear(self) -> None:
        """Drop all that waits: the peer is lost. Repeats are not counted: their envelopes were sent."""
        self.dropped[ShellReason.COPY_OVER_BUDGET] += self.count
        self.waiting = []

    # Room.

    def _wait_s(self, path: PathState, now: float, rate: Bucket | None, slack: float = 0.0) -> float:
        """How long until a datagram may be sent along a path, if nothing else is sent meanwhile.

        ``rate``: the limit of copies or repeats; None for a first datagram. ``slack``: bytes that may be missing.
        """
        waits = [] if rate is None else [rate.wait_s(-slack, now)]
        if (budget := self._budgets.get(path.path.socket)) is not None:
            waits.append(budget.all.wait_s(-DEBT_S * budget.all.rate - slack, now))
            if rate is not None:
                waits.append(budget.copies.wait_s(-slack, now))
        return max(waits, default=0.0)

    def _has_room(self, path: PathState, now: float, rate: Bucket | None) -> bool:
        return self._wait_s(path, now, rate, _SLACK_BYTES) == 0.0

    def _charge(self, datagram: bytes, path: PathState, now: float, rate: Bucket) -> int:
        size = wire_bytes(datagram, path.path)
        self._average.spend(size, now)
        if rate is not self._average:
            rate.spend(size, now)
        if (budget := self._budgets.get(path.path.socket)) is not None:
            budget.copies.spend(size, now)
        return size

    # The queue.

    def _put(self, newer: _Waiting) -> None:
        """Let it wait. It replaces older states of its kind, and the least important of too many are dropped."""
        rivals = [
            one
            for one in self.waiting
            if one.is_copy == newer.is_copy and (not newer.is_copy or one.paths == newer.paths)
        ]
        replaced = [one for one in rivals if one.is_replaceable and one.states <= newer.states]
        self._drop(replaced, ShellReason.COPY_REPLACED)
        self.waiting.append(newer)
        rivals = [one for one in rivals if one not in replaced] + [newer]
        size = sum(len(one.datagram) for one in rivals)
        while size > MAX_WAITING_BYTES if newer.is_copy else len(rivals) > MAX_ENVELOPES:
            least = max(rivals, key=lambda one: (one.rank, one.number))
            rivals.remove(least)
            size -= len(least.datagram)
            self._drop([least], ShellReason.COPY_OVER_BUDGET)

    def _drop(self, gone: Sequence[_Waiting], reason: ShellReason) -> None:
        if gone:
            self.waiting = [one for one in self.waiting if one not in gone]
            self.dropped[reason] += len(gone)


class Repair:
    """Whether critical envelopes to a peer are repeated, how often, and along which paths."""

    def __init__(self) -> None:
        self.transmissions = 1
        """How often a critical envelope goes along each path."""
        self.is_on = False
        """Whether envelopes are repeated,"""
        self.began_at = 0.0
        """and since when."""
        self.left_out: Sequence[PathState] = ()
        """Paths without repeats: they do not answer, or are so slow that repeats along another path arrive first."""
        self._losses: list[tuple[float, float]] = []

    def update(self, paths: Sequence[PathState], now: float, *, is_allowed: bool) -> None:
        """Judge the paths that carry critical frames. Call it about once a second."""
        if not is_allowed:
            self.end()
            return
        # A path that delivers everything, but too late, hides no loss. While no path answers, one may be dead.
        known = [path for path in paths if _answers(path) or now < path.answered_at + KNOWN_S] or paths
        fastest_s = min((path.srtt_s or 0.0 for path in known), default=0.0)
        quick = [path for path in known if (path.srtt_s or 0.0) <= fastest_s + 2 * MAX_WAIT_S]
        answering = [path for path in quick if _answers(path)]
        if not answering:  # the quick ones may be dead: a slow one that answers, and loses, needs repeats too
            quick += [path for path in known if _answers(path) and self._loss_of(path) > BEGIN_LOSS]
        self.left_out = [path for path in paths if path not in quick]
        losses = [self._loss_of(path) for path in answering or quick]
        self._losses.append((now, prod(losses) if answering else max(losses, default=0.0)))
        while self._losses[0][0] <= now - HOLD_S:
            self._losses.pop(0)
        highest = max(loss for _, loss in self._losses)
        if not self.is_on and highest > BEGIN_LOSS:
            self.is_on, self.began_at = True, now
        elif highest < END_LOSS:
            self.is_on = False
        # So often that what is lost each time is less than RESIDUAL_LOSS.
        most = TRANSMISSIONS if highest >= 1 else ceil(log(RESIDUAL_LOSS) / log(max(highest, RESIDUAL_LOSS)))
        self.transmissions = max(2, min(TRANSMISSIONS, most)) if self.is_on else 1

    def end(self) -> None:
        """Stop at once: the peer is lost, or its configuration has changed."""
        self.transmissions, self.is_on = 1, False
        self._losses.clear()

    def _loss_of(self, path: PathState) -> float:
        loss, lost = path.loss_to_repair()
        return max(loss, path.loss_out) if self.is_on or lost >= LEAST_LOST else 0.0


def _answers(path: PathState) -> bool:
    return path.condition is PathCondition.USABLE or path.reason == "loss"
