"""Token buckets: how much others can make us do, and the budget of group work."""

from __future__ import annotations

import pytest

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.limits import GroupBudget, SourceLimiter, TokenBucket, prefix_of, source_of

DEAREST = 100


def taken(bucket: TokenBucket, attempts: int, now: float) -> int:
    """How many of so many attempts succeed."""
    return sum(bucket.take(now) for _ in range(attempts))


def test_bucket_starts_full_and_refills_at_its_rate() -> None:
    """A token comes back just when the rate gives it, not before. A year of silence buys no more than one burst."""
    bucket = TokenBucket(2.0, 5, 100.0)
    assert taken(bucket, 20, 100.0) == 5
    assert [bucket.take(now) for now in (100.499, 100.5, 100.5)] == [False, True, False]
    assert taken(bucket, 20, 102.0) == 3
    assert taken(bucket, 20, 3e7) == 5


def test_bucket_gives_all_that_is_asked_or_nothing() -> None:
    """Too few tokens stay where they are. Spent tokens stay spent when the burst changes, as at a reload."""
    bucket = TokenBucket(2.0, 5, 0.0)
    assert not bucket.take(0.0, 5.5)
    assert bucket.has(0.0, 5)
    assert bucket.take(0.0, 4.5)
    assert not bucket.has(0.0)
    assert bucket.take(0.0, 0.5)
    bucket.set_burst(10)
    assert [bucket.has(0.0, count) for count in (5, 5.1)] == [True, False]
    bucket.set_burst(3)
    assert not bucket.has(0.0, 0.1)


def test_sources_have_their_own_buckets_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """The longest silent source is forgotten: one that goes on sending cannot win a fresh burst by a crowd."""
    monkeypatch.setattr(c, "SOURCES_TRACKED", 3)
    limiter = SourceLimiter(1.0, 2)
    assert [limiter.take("loud", 0.0) for _ in range(4)] == [True, True, False, False]
    for crowd in range(50):
        assert limiter.take(crowd, 0.0)
        assert not limiter.take("loud", 0.0)
        assert len(limiter._buckets) <= 3
    assert [limiter.take("loud", 1.0), limiter.take("loud", 1.0)] == [True, False]
    assert list(limiter._buckets) == [48, 49, "loud"]


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("10.0.0.1", "10.0.0.1", True),
        ("10.0.0.1", "10.0.0.2", False),
        ("2001:db8:1:2::7", "2001:db8:1:2:3:4:5:6", True),
        ("2001:db8:1:2::7", "2001:db8:1:3::7", False),
        ("fe80::1%wlan0", "fe80::2", True),
        # The gap ends within the first four groups: not all that is left out is behind them.
        ("fd00::5:aaaa:bbff:fecc:dddd", "fd00:0:0:5::7", True),
        ("fd00::5:aaaa:bbff:fecc:dddd", "fd00::6:aaaa:bbff:fecc:dddd", False),
    ],
)
def test_source_is_what_one_machine_may_own(one: str, other: str, is_same: bool) -> None:
    """An IPv4 address stands for itself, an IPv6 address for its /64. A network is a /24 or a /64."""
    assert (source_of(one) == source_of(other)) is is_same
    assert (prefix_of(one) == prefix_of(other)) is (is_same or "." in one)
    assert prefix_of("192.0.2.1") != prefix_of("192.0.3.1")


# Group work.


def share_of_a_peer() -> TokenBucket:
    """Unspent."""
    return TokenBucket(*c.GROUP_WORK_PER_PEER, 0.0)


def spent(budget: GroupBudget, share: TokenBucket, source: str, now: float = 0.0) -> int:
    """How many handshakes of the dearest suite are admitted at once."""
    count = 0
    while budget.take(share, source, DEAREST, now):
        count += 1
    return count


def test_shares_of_group_work() -> None:
    """A peer has two at once and one in five seconds from all sources; a source half of the budget, of all peers."""
    budget, share = GroupBudget(0.0), share_of_a_peer()
    assert [spent(budget, share, source) for source in "abc"] == [2, 0, 0]
    assert [budget.take(share, "d", DEAREST, now) for now in (4.9, 5.0)] == [False, True]
    budget = GroupBudget(0.0)
    assert (
        sum(spent(budget, share_of_a_peer(), "loud") for _ in range(30)) == c.GROUP_WORK_PER_SOURCE.burst // DEAREST
    )
    assert spent(budget, share_of_a_peer(), "quiet") == 2


def test_all_group_work_has_a_bound() -> None:
    """Many peers from many sources: the burst, then the rate."""
    budget = GroupBudget(0.0)
    for now, expected in ((0.0, c.GROUP_WORK.burst), (10.0, 10 * c.GROUP_WORK.per_s)):
        admitted = sum(spent(budget, share_of_a_peer(), f"host {number}", now) for number in range(50))
        assert admitted == expected // DEAREST


def test_what_is_refused_spends_nothing() -> None:
    """A refusal by one share leaves the others as they were."""
    budget, tired = GroupBudget(0.0), share_of_a_peer()
    spent(budget, tired, "a")
    total = budget._total._tokens
    assert [budget.take(tired, source, DEAREST, 0.0) for source in ("a", "b")] == [False, False]
    assert budget._total._tokens == total
    for _ in range(10):
        spent(budget, share_of_a_peer(), "a")
    unused, total = share_of_a_peer(), budget._total._tokens
    assert not budget.take(unused, "a", DEAREST, 0.0)
    assert (budget._total._tokens, unused._tokens) == (total, c.GROUP_WORK_PER_PEER.burst)
