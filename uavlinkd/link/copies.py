"""Copies for other paths of one peer: which are sent at once, which wait for a network's budget, which are dropped.

A critical envelope goes along every usable path. The first path carries it at once. Each further one carries a copy.
Copies must not take a slow network from the frames that it alone carries. So the copies of a peer use at most the
rate of its stream, or 64 kbit/s if that is more. Of a network's budget the copies of all peers use at most half.

A copy for which there is no room waits, sealed. Commands and heartbeats go first, then other events, then states.
Newer states replace a waiting copy that has no other frames. A copy that waited for :data:`MAX_WAIT_S` is dropped:
what it carries has arrived along another path, or comes again. A copy of an envelope of another class does not wait.
Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from math import inf
from typing import Final

from uavlinkd.core.outputs import Transmit
from uavlinkd.core.path import Path
from uavlinkd.link.network_budgets import LARGEST_BYTES, NetworkBudget, wire_bytes
from uavlinkd.link.shell_reasons import ShellReason
from uavlinkd.mavlink.classes import Lane
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame

MAX_WAIT_S: Final = 0.5
"""A copy that waits longer is dropped."""
DEBT_S: Final = 0.25
"""A copy is sent at once on a network whose budget is in debt by less than this."""
LEAST_BITS_S: Final = 64_000
"""What the copies of a peer may use at least, as far as networks allow it."""
AVERAGE_S: Final = 10
"""Repeats keep the rate on average over this time, so that a transfer of parameters may use what was not used before
it. On a network or for a peer with a budget this does not count."""
MAX_WAITING_BYTES: Final = 8192
"""Of the copies that wait for one path. The least important ones are dropped first, of these the oldest."""
_SLACK_BYTES: Final = 0.5  # a deadline computed in floating point must not come a hair early, over and over


class _WaitingCopy:
    """A copy that waits for one path."""

    __slots__ = ("datagram", "is_replaceable", "put_at", "rank", "states")

    def __init__(self, datagram: bytes, frames: Sequence[Frame], put_at: float) -> None:
        self.datagram = datagram
        self.put_at = put_at
        kinds = [frame.header.kind for frame in frames]
        self.is_replaceable = all(kind.is_state for kind in kinds)
        self.states: set[FlowKey] = {flow_key(frame) for frame in frames if frame.header.kind.is_state}
        self.rank = min(map(rank_of, frames))


def rank_of(frame: Frame) -> int:
    """The importance of a frame in a copy, 0 the highest."""
    kind = frame.header.kind
    if kind.lane is Lane.URGENT and (not kind.is_state or kind.may_be_old):  # a command or a heartbeat
        return 0
    return 2 if kind.is_state else 1


class Copies:
    """The copies for one peer. ``budgets``: by the number of the socket, of networks with a budget."""

    def __init__(self, budgets: Mapping[int, NetworkBudget], now: float) -> None:
        self.dropped: Counter[ShellReason] = Counter()
        """Copies that were not sent, by reason."""
        self._budgets = budgets
        self._rate = Bucket(LEAST_BITS_S, now, LARGEST_BYTES)
        self._average = Bucket(LEAST_BITS_S, now, AVERAGE_S * LEAST_BITS_S / 8)  # of copies and repeats
        self._waiting: dict[Path, list[_WaitingCopy]] = {}  # the oldest first

    @property
    def is_waiting(self) -> bool:
        """Whether copies wait."""
        return bool(self._waiting)

    @property
    def count(self) -> int:
        """How many copies wait."""
        return sum(map(len, self._waiting.values()))

    def set_stream_rate(self, bytes_s: float, now: float, most_bytes_s: float = inf) -> None:
        """Copies may use as much as the stream of this peer, which has so many bytes a second.

        ``most_bytes_s``: a part of the peer's own budget, if it has one.
        """
        rate = min(most_bytes_s, max(LEAST_BITS_S / 8, bytes_s))
        self._rate.set_rate(rate, now)
        self._average.set_rate(rate, now)
        self._average.set_least_burst(AVERAGE_S * rate if most_bytes_s == inf else LARGEST_BYTES)

    def pick(self, outputs: Sequence[Transmit], frames: Sequence[Frame] | None, now: float) -> list[Transmit]:
        """Of the datagrams of one envelope, those that are sent now. The others wait, or are dropped.

        ``frames``: those in the envelope, if it is critical; None for another class, whose copies do not wait.
        """
        picked: list[Transmit] = []
        waiting: list[Transmit] = []
        for transmit in outputs:
            if self._has_room(transmit, now, is_copy=bool(picked)):
                picked.append(transmit)
            else:
                waiting.append(transmit)
        if waiting and not picked:
            # No network has room, although one had when the envelope was sealed: the best path pays with debt.
            picked.append(waiting.pop(0))
        for transmit in picked[1:]:
            self.charge(transmit, now)
        for transmit in waiting:
            if frames is None:
                self.dropped[ShellReason.COPY_OVER_BUDGET] += 1
            else:
                self._put(transmit, frames, now)
        return picked

    def release(self, now: float) -> list[Transmit]:
        """The waiting copies for which there is room now. Those that waited too long are dropped."""
        released: list[Transmit] = []
        for path, waiting in list(self._waiting.items()):
            self._drop_old(waiting, now)
            while waiting:
                copy = min(waiting, key=_by_rank)
                transmit = Transmit(copy.datagram, path, is_copy=True)
                if not self._has_room(transmit, now, is_copy=True, is_next=True):
                    break
                waiting.remove(copy)
                self.charge(transmit, now)
                released.append(transmit)
            if not waiting:
                del self._waiting[path]
        return released

    def next_deadline(self, now: float) -> float:
        """When :meth:`release` has something to do; infinity while no copy waits."""
        return min((self._release_at(path, now) for path in self._waiting), default=inf)

    def _release_at(self, path: Path, now: float) -> float:
        """When a copy that waits for this path is sent or dropped."""
        wait_s = max(self._rate.wait_s(0.0, now), self._budget_wait_s(path, now))
        return min(now + wait_s, self._waiting[path][0].put_at + MAX_WAIT_S)

    def repeat_at(self, path: Path, now: float) -> float:
        """When there may be room for a repeat along a path: after the copies that wait for it."""
        at = now + max(self._average.wait_s(0.0, now), self._budget_wait_s(path, now))
        return max(at, self._release_at(path, now)) if path in self._waiting else at

    def _budget_wait_s(self, path: Path, now: float) -> float:
        wait_s = 0.0
        if (budget := self._budgets.get(path.socket)) is not None:
            wait_s = budget.copies.wait_s(0.0, now)
            wait_s = max(wait_s, budget.all.wait_s(-DEBT_S * budget.all.rate, now))
        return wait_s

    def has_room_for_repeat(self, transmit: Transmit, now: float) -> bool:
        """Whether a repeat may be sent now. Copies that wait for its path go first."""
        path = transmit.path
        if path in self._waiting or self._average.level(now) < -_SLACK_BYTES:
            return False
        return self._has_budget(transmit, now, is_copy=True)

    def clear(self) -> None:
        """Drop all copies that wait: the peer is lost."""
        if self._waiting:
            self.dropped[ShellReason.COPY_OVER_BUDGET] += self.count
            self._waiting.clear()

    def _has_room(self, transmit: Transmit, now: float, *, is_copy: bool, is_next: bool = False) -> bool:
        """Whether a datagram may be sent now. ``is_next``: it waits already, and its turn has come."""
        path = transmit.path
        if is_copy and not is_next and path in self._waiting:
            return False
        if is_copy and self._rate.level(now) < -_SLACK_BYTES:
            return False
        return self._has_budget(transmit, now, is_copy=is_copy)

    def _has_budget(self, transmit: Transmit, now: float, *, is_copy: bool) -> bool:
        budget = self._budgets.get(transmit.path.socket)
        if budget is None:
            return True
        if is_copy and budget.copies.level(now) < -_SLACK_BYTES:
            return False
        level = budget.all.level(now)
        return (
            level >= wire_bytes(transmit.datagram, transmit.path) or level >= -DEBT_S * budget.all.rate - _SLACK_BYTES
        )

    def charge(self, copy: Transmit, now: float) -> None:
        """Charge a copy that is sent."""
        self._rate.spend(wire_bytes(copy.datagram, copy.path), now)
        self.charge_repeat(copy, now)

    def charge_repeat(self, repeat: Transmit, now: float) -> None:
        """Charge a repeat that is sent."""
        size = wire_bytes(repeat.datagram, repeat.path)
        self._average.spend(size, now)
        if (budget := self._budgets.get(repeat.path.socket)) is not None:
            budget.copies.spend(size, now)

    def _put(self, transmit: Transmit, frames: Sequence[Frame], now: float) -> None:
        waiting = self._waiting.setdefault(transmit.path, [])
        newer = _WaitingCopy(transmit.datagram, frames, now)
        kept = [copy for copy in waiting if not (copy.is_replaceable and copy.states <= newer.states)]
        if len(kept) < len(waiting):
            self.dropped[ShellReason.COPY_REPLACED] += len(waiting) - len(kept)
        kept.append(newer)
        size = sum(len(copy.datagram) for copy in kept)
        while size > MAX_WAITING_BYTES:
            dropped = max(kept, key=_by_rank)  # of equals the first
            kept.remove(dropped)
            size -= len(dropped.datagram)
            self.dropped[ShellReason.COPY_OVER_BUDGET] += 1
        waiting[:] = kept

    def _drop_old(self, waiting: list[_WaitingCopy], now: float) -> None:
        while waiting and now >= waiting[0].put_at + MAX_WAIT_S:
            del waiting[0]
            self.dropped[ShellReason.COPY_OVER_BUDGET] += 1


def _by_rank(copy: _WaitingCopy) -> int:
    return copy.rank
