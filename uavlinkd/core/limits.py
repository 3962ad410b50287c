"""Bounds on what others can make us do: a token bucket, and one bucket per source in bounded memory."""

from __future__ import annotations

from collections.abc import Hashable
from ipaddress import IPv6Address


class TokenBucket:
    """At most ``rate`` events a second on average, ``burst`` at once. Starts full."""

    __slots__ = ("_at", "_burst", "_rate", "_tokens")

    def __init__(self, rate: float, burst: float, now: float) -> None:
        self._rate = rate
        self._burst = burst
        self._tokens = burst
        self._at = now

    def has(self, now: float, amount: float = 1.0) -> bool:
        """Whether so many tokens are there."""
        self._tokens = min(self._burst, self._tokens + (now - self._at) * self._rate)
        self._at = now
        return self._tokens >= amount

    def take(self, now: float, amount: float = 1.0) -> bool:
        """Take so many tokens; False, and none is taken, when there are fewer."""
        if not self.has(now, amount):
            return False
        self._tokens -= amount
        return True


def source_of(host: str) -> Hashable:
    """Whom a numeric host stands for: itself, or its /64 in IPv6, of which a single machine has every address."""
    return IPv6Address(host).packed[:8] if ":" in host else host


def prefix_of(host: str) -> Hashable:
    """The network of a numeric host: its /24 in IPv4, its /64 in IPv6."""
    return IPv6Address(host).packed[:8] if ":" in host else host.rpartition(".")[0]


class SourceLimiter:
    """A token bucket per source, for the ``capacity`` sources heard last."""

    def __init__(self, rate: float, burst: float, capacity: int) -> None:
        self._rate = rate
        self._burst = burst
        self._capacity = capacity
        self._buckets: dict[Hashable, TokenBucket] = {}

    def take(self, source: Hashable, now: float, amount: float = 1.0) -> bool:
        """Take so many tokens of this source; False, and none is taken, when it has fewer."""
        bucket = self._buckets.pop(source, None) or TokenBucket(self._rate, self._burst, now)
        self._buckets[source] = bucket  # a dict keeps order: the longest silent source comes first
        if len(self._buckets) > self._capacity:
            del self._buckets[next(iter(self._buckets))]
        return bucket.take(now, amount)
