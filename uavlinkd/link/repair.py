"""Whether critical envelopes to a peer are repeated, and how often. Specification, section 15.

Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import ceil, log, prod
from typing import Final

from uavlinkd.core.constants import TRANSMISSIONS
from uavlinkd.core.path_state import PathState

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


def transmissions_for(loss: float) -> int:
    """How often to send an envelope along paths that lose this share together, the first time included."""
    if loss <= RESIDUAL_LOSS:
        return 1
    return TRANSMISSIONS if loss >= 1 else min(TRANSMISSIONS, ceil(log(RESIDUAL_LOSS) / log(loss)))


class Repair:
    """The state of repair for one peer."""

    def __init__(self) -> None:
        self.transmissions = 1
        """How often a critical envelope goes along each path."""
        self.began_at: float | None = None
        self._losses: deque[tuple[float, float]] = deque()

    @property
    def is_on(self) -> bool:
        """Whether envelopes are repeated."""
        return self.began_at is not None

    def update(self, paths: Sequence[PathState], now: float, *, is_allowed: bool) -> None:
        """Judge the working paths that carry critical frames. Call it about once a second."""
        if not is_allowed:
            self.end()
            return
        self._losses.append((now, prod(map(self._loss_of, paths)) if paths else 0.0))
        while self._losses[0][0] <= now - HOLD_S:
            self._losses.popleft()
        highest = max(loss for _, loss in self._losses)
        if self.began_at is None and highest > BEGIN_LOSS:
            self.began_at = now
        elif highest < END_LOSS:
            self.began_at = None
        self.transmissions = max(2, transmissions_for(highest)) if self.is_on else 1

    def end(self) -> None:
        """Stop at once: the peer is lost, or its configuration has changed."""
        self.transmissions, self.began_at = 1, None
        self._losses.clear()

    def _loss_of(self, path: PathState) -> float:
        loss, lost = path.loss_to_repair()
        return loss if self.is_on or lost >= LEAST_LOST else 0.0
