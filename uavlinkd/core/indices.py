"""Session indices: 16-bit handles under which the peers address our sessions and pending initiations."""

from __future__ import annotations

from typing import Generic, TypeVar

from uavlinkd.core.constants import INDEX_QUARANTINE_S, QUARANTINED_PER_PEER
from uavlinkd.core.crypto import Entropy
from uavlinkd.core.drops import Drop, DropReason

_DRAWS = 64  # with half of all indices taken, all draws fail once in 2^64

Owner_co = TypeVar("Owner_co", covariant=True)


class Indices(Generic[Owner_co]):
    """What each index leads to; unpredictable new ones; a quarantine for those that carried a session."""

    def __init__(self, entropy: Entropy) -> None:
        self.owners: dict[int, Owner_co] = {}
        self._entropy = entropy
        self._quarantine: dict[int, tuple[float, str]] = {}  # free again at, and whose; the oldest is first
        self._quarantined_of: dict[str, dict[int, None]] = {}  # the same by peer

    def pick(self, now: float) -> int:
        """An index without an owner: 1 to 65535. It stays free until it is put into :attr:`owners`.

        Raises:
            Drop: ``NO_FREE_INDEX``.
        """
        self._release(now)
        for _ in range(_DRAWS):
            index = int.from_bytes(self._entropy(2), "big")
            if index and index not in self.owners and index not in self._quarantine:
                return index
        raise Drop(DropReason.NO_FREE_INDEX)

    def retire(self, index: int, peer: str, now: float) -> None:
        """The session of ``peer`` at ``index`` has ended; what still arrives for it is late."""
        self.owners.pop(index, None)
        self._quarantine[index] = now + INDEX_QUARANTINE_S, peer
        quarantined = self._quarantined_of.setdefault(peer, {})
        quarantined[index] = None
        if len(quarantined) > QUARANTINED_PER_PEER:
            self._free(next(iter(quarantined)))

    def forget(self, index: int) -> None:
        """Free an index that never carried a session."""
        self.owners.pop(index, None)

    def is_quarantined(self, index: int, now: float) -> bool:
        """Whether a session ended at ``index`` recently."""
        return index in self._quarantine and self._quarantine[index][0] > now

    def _release(self, now: float) -> None:
        while self._quarantine:
            oldest = next(iter(self._quarantine))
            if self._quarantine[oldest][0] > now:
                return
            self._free(oldest)

    def _free(self, index: int) -> None:
        _, peer = self._quarantine.pop(index)
        del self._quarantined_of[peer][index]
        if not self._quarantined_of[peer]:
            del self._quarantined_of[peer]
