"""Bounds on what others can make us do: token buckets, one per source in bounded memory, and those for groups."""

from __future__ import annotations

from collections.abc import Hashable
from ipaddress import IPv6Address

from uavlinkd.protocol import constants as c


class TokenBucket:
    """At most ``rate`` events a second on average, ``burst`` at once. Starts full."""

    __slots__ = ("_at", "_burst", "_rate", "_tokens")

    def __init__(self, rate: float, burst: float, now: float) -> None:
        self._rate = rate
        self._burst = burst
        self._tokens = burst
        self._at = now

    def has(self, now: float, count: float = 1.0) -> bool:
        """Whether the bucket has this many tokens."""
        self._tokens = min(self._burst, self._tokens + (now - self._at) * self._rate)
        self._at = now
        return self._tokens >= count

    def take(self, now: float, count: float = 1.0) -> bool:
        """Remove this many tokens. With fewer, remove nothing and return False."""
        if not self.has(now, count):
            return False
        self._tokens -= count
        return True

    def set_burst(self, burst: float) -> None:
        """Have another burst. What was spent stays spent."""
        self._tokens = max(0.0, self._tokens + burst - self._burst)
        self._burst = burst


def source_of(host: str) -> Hashable:
    """The source of a numeric host: itself, or its /64 in IPv6, because one machine may have every address of it."""
    return IPv6Address(host).packed[:8] if _is_ipv6(host) else host


def prefix_of(host: str) -> Hashable:
    """The network of a numeric host: its /24 in IPv4, its /64 in IPv6. Of another host, itself."""
    return IPv6Address(host).packed[:8] if _is_ipv6(host) else host.rpartition(".")[0] or host


def _is_ipv6(host: str) -> bool:
    return ":" in host and "/" not in host  # no URL


class SourceLimiter:
    """A token bucket per source, for the :data:`c.SOURCES_TRACKED` sources that were received last."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._buckets: dict[Hashable, TokenBucket] = {}

    def take(self, source: Hashable, now: float, count: float = 1.0) -> bool:
        """Remove this many tokens of the source. With fewer, remove nothing and return False."""
        bucket = self._buckets.pop(source, None) or TokenBucket(self._rate, self._burst, now)
        self._buckets[source] = bucket  # a dict keeps order: the longest silent source comes first
        if len(self._buckets) > c.SOURCES_TRACKED:
            del self._buckets[next(iter(self._buckets))]
        return bucket.take(now, count)


class GroupBudget:
    """Group arithmetic of a responder: one budget for all peers, and in it a share for each source and each peer.

    The unit is a hundredth of an encapsulation of ``ffdhe8192`` (:attr:`Suite.work`).
    """

    def __init__(self, now: float) -> None:
        self._total = TokenBucket(*c.GROUP_WORK, now)
        self._sources = SourceLimiter(*c.GROUP_WORK_PER_SOURCE)

    def take(self, share: TokenBucket, source: Hashable, work: int, now: float) -> bool:
        """Spend ``work``. False, and nothing is spent, if the total, the peer (``share``) or the source has less."""
        budgets = self._total, share
        if not all(budget.has(now, work) for budget in budgets) or not self._sources.take(source, now, work):
            return False
        return all(budget.take(now, work) for budget in budgets)
