"""Repeats of critical envelopes along lossy paths, within what copies may use. Specification, section 15.

Each envelope waits once, with the paths along which it goes, until it was sent often enough. The peer has one
deadline for all of them. Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Sequence
from math import inf
from typing import Final, NamedTuple

from uavlinkd.core.outputs import Transmit
from uavlinkd.core.path import Path
from uavlinkd.link.copies import MAX_WAIT_S, Copies, rank_of
from uavlinkd.link.network_budgets import wire_bytes
from uavlinkd.link.shell_reasons import ShellReason
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame

SPACING_S: Final = 0.02
"""Between two transmissions of an envelope: a short burst of losses does not hit both."""
MAX_ENVELOPES: Final = 256
"""Of one peer that wait for repeats."""


class Repeat(NamedTuple):
    """A transmission to send now, and its number along its path, from 2."""

    transmit: Transmit
    number: int


class _Envelope:
    """An envelope that is sent again."""

    __slots__ = ("datagram", "due_at", "is_replaceable", "last", "number", "paths", "put_at", "rank", "states")

    def __init__(
        self, datagram: bytes, paths: Sequence[Path], frames: Sequence[Frame], transmissions: int, now: float
    ) -> None:
        self.datagram = datagram
        self.paths = paths
        self.number = 2
        self.last = transmissions
        self.put_at = now
        self.due_at = now + SPACING_S
        self.is_replaceable = all(frame.header.kind.is_state for frame in frames)
        self.states: set[FlowKey] = {flow_key(frame) for frame in frames if frame.header.kind.is_state}
        self.rank = min(map(rank_of, frames))


class Repeats:
    """The envelopes to one peer that are repeated. ``copies``: has the budget of both."""

    def __init__(self, copies: Copies) -> None:
        self.sent = self.bytes_sent = 0
        """Repeats so far, and their bytes with IP and UDP headers."""
        self.dropped: Counter[ShellReason] = copies.dropped
        self._copies = copies
        self._waiting: list[_Envelope] = []

    @property
    def is_waiting(self) -> bool:
        """Whether envelopes wait."""
        return bool(self._waiting)

    @property
    def count(self) -> int:
        """How many envelopes wait."""
        return len(self._waiting)

    def put(
        self, datagram: bytes, paths: Sequence[Path], frames: Sequence[Frame], transmissions: int, now: float
    ) -> None:
        """An envelope with these frames was sent along these paths; repeat it up to so many ``transmissions``."""
        newer = _Envelope(datagram, paths, frames, transmissions, now)
        if newer.states:
            kept = [one for one in self._waiting if not (one.is_replaceable and one.states <= newer.states)]
            if len(kept) < len(self._waiting):
                self.dropped[ShellReason.COPY_REPLACED] += len(self._waiting) - len(kept)
            self._waiting = kept
        self._waiting.append(newer)
        if len(self._waiting) > MAX_ENVELOPES:
            self._waiting.remove(max(self._waiting, key=_order))
            self.dropped[ShellReason.COPY_OVER_BUDGET] += 1

    def release(self, paths: Container[Path], now: float) -> list[Repeat]:
        """The repeats that are due and for which there is room. Those that waited too long are dropped.

        ``paths``: those that are not gone. Along others nothing is repeated.
        """
        self._drop_old(now)
        for one in self._waiting:
            one.paths = [path for path in one.paths if path in paths]
        self._waiting = [one for one in self._waiting if one.paths]
        released: list[Repeat] = []
        for one in sorted((one for one in self._waiting if one.due_at <= now), key=_order):
            transmits = [Transmit(one.datagram, path, is_copy=True) for path in one.paths]
            sent = False
            for transmit in transmits:
                if self._copies.has_room_for_repeat(transmit, now):
                    self._copies.charge_repeat(transmit, now)
                    self.sent += 1
                    self.bytes_sent += wire_bytes(transmit.datagram, transmit.path)
                    released.append(Repeat(transmit, one.number))
                    sent = True
            if sent:
                one.number += 1
                one.due_at = now + SPACING_S
        self._waiting = [one for one in self._waiting if one.number <= one.last]
        return released

    def next_deadline(self, now: float) -> float:
        """When :meth:`release` has something to do; infinity while no envelope waits."""
        at = inf
        for one in self._waiting:
            if one.due_at > now:
                at = min(at, one.due_at)
            else:
                at = min(at, one.put_at + MAX_WAIT_S, *(self._copies.repeat_at(path, now) for path in one.paths))
        return at

    def clear(self) -> None:
        """Drop all that wait: the peer is lost."""
        self._waiting = []

    def _drop_old(self, now: float) -> None:
        kept = [one for one in self._waiting if now < one.put_at + MAX_WAIT_S]
        if len(kept) < len(self._waiting):
            self.dropped[ShellReason.COPY_OVER_BUDGET] += len(self._waiting) - len(kept)
            self._waiting = kept


def _order(one: _Envelope) -> tuple[int, int, float]:
    return one.rank, one.number, one.put_at
