"""Whether a peer sends more to an address than came from there: it could be used to flood whoever that is."""

from __future__ import annotations

from collections import Counter, deque

CREDIT_S = 10.0
"""How long a datagram may be answered. Were it for ever, a thousand unanswered ones would hide a thousand answers of
twice the size of what they answer. Long enough for a busy machine."""


class Amplification:
    """Compares what came back with what was sent within :data:`CREDIT_S` before, for each peer and stranger.

    A stranger is an address of the attacker's own: it has proved nothing, and may get as many bytes as it sent. Times
    are monotonic seconds. What it remembers is bounded by the rate of the attack.
    """

    def __init__(self) -> None:
        self.excess: Counter[tuple[str, int]] = Counter()
        """By peer and stranger: bytes that came back beyond those sent lately."""
        self._credits: dict[tuple[str, int], deque[list[float]]] = {}  # when, and the bytes that are left of it

    def sent(self, peer: str, stranger: int, size: int, now: float) -> None:
        """So many bytes went from the stranger to the peer."""
        unanswered = self._credits.setdefault((peer, stranger), deque())
        self._expire(unanswered, now)
        unanswered.append([now, size])

    def came_back(self, peer: str, stranger: int, size: int, now: float) -> None:
        """So many came back: they use up what was sent, the oldest first."""
        unanswered = self._credits.get((peer, stranger), deque())
        self._expire(unanswered, now)
        left = float(size)
        while left and unanswered:
            used = min(left, unanswered[0][1])
            unanswered[0][1] -= used
            left -= used
            if not unanswered[0][1]:
                unanswered.popleft()
        if left:
            self.excess[peer, stranger] += int(left)

    @staticmethod
    def _expire(unanswered: deque[list[float]], now: float) -> None:
        while unanswered and now - unanswered[0][0] > CREDIT_S:
            unanswered.popleft()
