"""What group arithmetic may cost: the one step of a handshake that takes milliseconds.

The unit is a hundredth of an encapsulation of ``ffdhe8192`` (:attr:`Suite.work`). Only the responder's side is here:
an initiator computes once for each of its own initiations (:class:`uavlinkd.core.kem.OneCiphertext`).
"""

from __future__ import annotations

from collections.abc import Hashable

from uavlinkd.core import constants as c
from uavlinkd.core.limits import SourceLimiter, TokenBucket


class GroupShare:
    """What one peer may cause: from anywhere, and besides where it proves to be at its own address."""

    __slots__ = ("anywhere", "proven")

    def __init__(self, now: float) -> None:
        self.anywhere = TokenBucket(c.GROUP_WORK_PER_PEER_PER_S, c.GROUP_WORK_PER_PEER_BURST, now)
        self.proven = TokenBucket(c.GROUP_WORK_PER_PEER_PER_S, c.GROUP_WORK_PER_PEER_BURST, now)


class GroupBudget:
    """One budget for all peers, and in it a share for each source and each peer."""

    def __init__(self, now: float) -> None:
        self._total = TokenBucket(c.GROUP_WORK_PER_S, c.GROUP_WORK_BURST, now)
        self._sources = SourceLimiter(c.GROUP_WORK_PER_SOURCE_PER_S, c.GROUP_WORK_PER_SOURCE_BURST, c.SOURCES_TRACKED)

    def take(self, share: GroupShare, source: Hashable, work: int, now: float) -> bool:
        """Spend ``work``; False, and nothing is spent, where the total, the peer or the source has less."""
        if not self._total.has(now, work) or not share.anywhere.has(now, work):
            return False
        if not self._sources.take(source, now, work):
            return False
        return self._total.take(now, work) and share.anywhere.take(now, work)
