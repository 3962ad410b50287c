"""Frames that overtook others along another path, and wait for these. README.md, section 15."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.outputs import Output
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.paths import PathSet
from uavlinkd.protocol.session import Session


class EarlyEnvelope(NamedTuple):
    """An envelope with frames that arrived."""

    order: int
    session: Session
    path: PathState
    frames: Sequence[Output]
    is_along_best: bool
    """Whether the path is the sender's best one: a probe is in front of the frames."""
    due_at: float = 0.0
    """When its frames wait no more."""


class EarlyFrames:
    """The early frames of one peer.

    A copy along a faster path overtakes the stream, and so does the stream itself after a change to a faster path.
    Of equal paths, now one and now the other is faster: delays vary.
    Such an envelope waits until those before it are here, or for as long as they may arrive later.
    """

    __slots__ = ("_newest", "_paths", "_waiting", "highest")

    def __init__(self, paths: PathSet) -> None:
        self.highest = -1
        """The highest order of the envelopes whose frames do not wait."""
        self._paths = paths
        self._newest: EarlyEnvelope | None = None  # along the sender's best path
        self._waiting: list[EarlyEnvelope] = []  # in the order in which they were sealed

    @property
    def due_at(self) -> float:
        """When to call :meth:`release`; infinity while no frames wait."""
        return self._waiting[0].due_at if self._waiting else c.NEVER

    def arrive(self, arrived: EarlyEnvelope, now: float) -> list[Output]:
        """What is delivered when an envelope arrives."""
        waiting = self._waiting
        due_at = self._due_at(arrived.path, now)
        if due_at > now and (arrived.order > waiting[0].order if waiting else not self._is_next(arrived)):
            waiting.append(arrived._replace(due_at=due_at))
            waiting.sort(key=itemgetter(0))
            return [] if len(waiting) < c.EARLY_ENVELOPES else self.release(c.NEVER)
        out = [*self._release(arrived.order), *self._pass(arrived)]
        while waiting and self._is_next(waiting[0]):
            out += self._pass(waiting.pop(0))
        return out

    def release(self, now: float) -> list[Output]:
        """The frames that wait no more."""
        due = [envelope.order for envelope in self._waiting if envelope.due_at <= now]
        return self._release(due[-1]) if due else []

    def _release(self, order: int) -> list[Output]:
        out: list[Output] = []
        while self._waiting and self._waiting[0].order <= order:
            out += self._pass(self._waiting.pop(0))
        return out

    def note(self, order: int) -> bool:
        """Note an envelope whose frames do not wait. Returns whether one that was sealed later came before it."""
        is_overtaken, self.highest = order < self.highest, max(self.highest, order)
        return is_overtaken

    def _pass(self, envelope: EarlyEnvelope) -> Sequence[Output]:
        self.note(envelope.order)
        if envelope.is_along_best and (self._newest is None or envelope.order > self._newest.order):
            self._newest = envelope
        return envelope.frames

    def _is_next(self, envelope: EarlyEnvelope) -> bool:
        """Whether no envelope before this one is missing."""
        base = envelope.session.order_base
        missing = range(self.highest + 1 - base, envelope.order - base)
        return len(missing) < c.EARLY_ENVELOPES and all(map(envelope.session.window.is_used, missing))

    def _due_at(self, path: PathState, now: float) -> float:
        """Until when an envelope that arrived along this path waits for the stream; at most now if it does not."""
        best = self._paths.best if self._newest is None else self._newest.path
        if best is None or best is path or not (best.works and path.is_validated):
            return now
        early_s = path.head_start_s(best)
        return now + early_s + c.EARLY_MARGIN_S if early_s <= c.EARLY_MOST_S else now
