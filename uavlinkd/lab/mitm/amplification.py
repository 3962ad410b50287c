"""Detects amplification: a peer that sends more to an address than it received from there can flood that address."""

from __future__ import annotations

from collections import Counter, deque

CREDIT_S = 10.0
"""How long a datagram counts as a request. Without a limit, a thousand unanswered datagrams would hide a thousand
answers of twice the size. 10 s is enough for a busy machine."""


class Amplification:
    """Compares the bytes received by a stranger with the bytes it sent within :data:`CREDIT_S` before, per peer.

    A stranger is an address of the attacker. It is not validated, so a peer may send it as many bytes as it received
    from there. Times are monotonic seconds. The rate of the attack bounds the memory.
    """

    def __init__(self) -> None:
        self.excess: Counter[tuple[str, int]] = Counter()
        """By peer and stranger: bytes received beyond those recently sent."""
        self._credits: dict[tuple[str, int], deque[list[float]]] = {}  # time, remaining bytes

    def sent(self, peer: str, stranger: int, size: int, now: float) -> None:
        """The stranger sent ``size`` bytes to the peer."""
        unanswered = self._credits.setdefault((peer, stranger), deque())
        self._expire(unanswered, now)
        unanswered.append([now, size])

    def received(self, peer: str, stranger: int, size: int, now: float) -> None:
        """The peer sent ``size`` bytes to the stranger. They use up the oldest sent bytes first."""
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
