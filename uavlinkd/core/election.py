"""Which path of a peer is the best: the one with the lowest cost, unless the best one so far is about as good.

README.md, section 15.
"""

from __future__ import annotations

from collections.abc import Iterable

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.path_state import PathCondition, PathState


class Election:
    """Elects the best path. It remembers which path has been better for how long."""

    __slots__ = ("_better", "_better_since", "_chosen", "_chosen_at")

    def __init__(self) -> None:
        self._better: PathState | None = None
        self._better_since = NEVER
        self._chosen: PathState | None = None  # the best path, and since when
        self._chosen_at = -NEVER

    @property
    def due_at(self) -> float:
        """When a better path has proved itself; infinity without one."""
        return NEVER if self._better is None else self._better_since + c.BETTER_FOR_S

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
        pool = [state for state in working if not state.is_metered] or working
        usable = [state for state in pool if state.condition is PathCondition.USABLE]
        if best is None or best not in pool:
            self._better = None
            if not pool:
                return best, ""
            elected = min(usable or pool, key=lambda state: _cost(state, None))
            return elected, "first" if best is None else "metered" if best.works else best.reason
        rivals = [state for state in usable if state is not best and now >= state.returns_at]
        if best.path.is_relayed and (direct := [state for state in rivals if not state.path.is_relayed]):
            elected = min(direct, key=lambda state: _cost(state, None))
            if _better_than(elected, [best], now) is None:
                return elected, "direct"
        rival = _better_than(best, rivals, now) if rivals else None
        if rival is None or rival is not self._better:
            self._better, self._better_since = rival, now
        if rival is None or now < self.due_at:
            return best, ""
        if best.loss_out < c.SUSPECT_LOSS:
            return rival, "faster"
        # A path that loses only what the best path carries would be elected again and again.
        best.note_lost_election(now, is_again=now < self._chosen_at + c.HELD_BACK_MOST_S)
        return rival, "loss"


def _better_than(best: PathState, rivals: list[PathState], now: float) -> PathState | None:
    """The best of the rivals, if its cost is lower by enough."""
    lags = {state: lag for state in (best, *rivals) if (lag := state.lag_s(now)) is not None}
    shown = lags if len(lags) > len(rivals) else None  # lags are comparable only if all are known
    rival = min(rivals, key=lambda state: _cost(state, shown))
    old, new = _cost(best, shown), _cost(rival, shown)
    return rival if new <= (1 - c.BETTER_SHARE) * old and new <= old - c.BETTER_BY_S else None


def _cost(state: PathState, lags: dict[PathState, float] | None) -> float:
    """What is compared, in seconds: one-way delay, and a penalty for loss."""
    delay_s = (state.srtt_s or 0.0) / 2 if lags is None else lags[state]
    return delay_s + c.LOSS_PENALTY_S * state.loss_out
