"""Token buckets: how much others can make us do."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.core.limits import SourceLimiter, TokenBucket, prefix_of, source_of


def taken(bucket: TokenBucket, attempts: int, now: float) -> int:
    """How many of so many attempts succeed."""
    return sum(bucket.take(now) for _ in range(attempts))


def test_bucket_starts_full() -> None:
    """The whole burst is there at once, and not one more."""
    assert taken(TokenBucket(2.0, 5, 100.0), 20, 100.0) == 5


def test_bucket_refills_at_its_rate() -> None:
    """A token comes back just when the rate gives it, not before."""
    bucket = TokenBucket(2.0, 5, 100.0)
    taken(bucket, 5, 100.0)

    assert not bucket.take(100.499)
    assert bucket.take(100.5)
    assert not bucket.take(100.5)
    assert taken(bucket, 20, 102.0) == 3


def test_bucket_never_holds_more_than_its_burst() -> None:
    """A year of silence buys no more than one burst."""
    bucket = TokenBucket(2.0, 5, 0.0)

    assert taken(bucket, 20, 3e7) == 5


@given(st.lists(st.floats(0, 2), max_size=60), st.floats(0.5, 20), st.integers(1, 10))
def test_bucket_never_exceeds_burst_and_rate(steps: list[float], rate: float, burst: int) -> None:
    """Over any pattern of attempts, no more passes than the burst and the rate times the time."""
    bucket = TokenBucket(rate, burst, 0.0)
    now, passed = 0.0, 0
    for step in steps:
        now += step
        passed += bucket.take(now)
        assert passed <= burst + rate * now + 1e-6


def test_bucket_gives_all_that_is_asked_or_nothing() -> None:
    """Too few tokens stay where they are, for one that asks for less."""
    bucket = TokenBucket(2.0, 5, 0.0)

    assert not bucket.take(0.0, 5.5)
    assert bucket.has(0.0, 5)
    assert bucket.take(0.0, 4.5)
    assert not bucket.has(0.0)
    assert bucket.take(0.0, 0.5)


def test_prefix_is_the_network_of_a_host() -> None:
    """A /24 in IPv4, a /64 in IPv6."""
    assert prefix_of("192.0.2.1") == prefix_of("192.0.2.254") != prefix_of("192.0.3.1")
    assert prefix_of("2001:db8::1") == prefix_of("2001:db8::ffff:0:0:1") != prefix_of("2001:db8:0:1::1")


def test_sources_have_their_own_buckets() -> None:
    """One source that sends too much takes nothing from another."""
    limiter = SourceLimiter(1.0, 2, 10)

    assert [limiter.take("loud", 0.0) for _ in range(4)] == [True, True, False, False]
    assert limiter.take("quiet", 0.0)
    assert [limiter.take("loud", 1.0), limiter.take("loud", 1.0)] == [True, False]


def test_memory_for_sources_is_bounded() -> None:
    """However many sources there are, only the most recent ones are remembered, up to the capacity."""
    limiter = SourceLimiter(1.0, 1, 3)
    for source in range(1000):
        assert limiter.take(source, 0.0)
        assert len(limiter._buckets) <= 3

    assert list(limiter._buckets) == [997, 998, 999]


def test_the_longest_silent_source_is_forgotten() -> None:
    """A source that goes on sending stays known, so it cannot win a fresh burst by a crowd."""
    limiter = SourceLimiter(1.0, 1, 2)
    assert limiter.take("loud", 0.0)
    for crowd in range(50):
        limiter.take(crowd, 0.0)
        assert not limiter.take("loud", 0.0)


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("10.0.0.1", "10.0.0.1", True),
        ("10.0.0.1", "10.0.0.2", False),
        ("2001:db8:1:2::7", "2001:db8:1:2:3:4:5:6", True),
        ("2001:db8:1:2::7", "2001:db8:1:3::7", False),
        ("2001:db8::1", "2001:db8:0:0:ffff::", True),
        ("fe80::1%wlan0", "fe80::2", True),
        ("::1", "::2", True),
        # The gap ends within the first four groups: not all that is left out is behind them.
        ("fd00::5:aaaa:bbff:fecc:dddd", "fd00:0:0:5::7", True),
        ("fd00::5:aaaa:bbff:fecc:dddd", "fd00::6:aaaa:bbff:fecc:dddd", False),
    ],
)
def test_source_is_what_one_machine_may_own(one: str, other: str, is_same: bool) -> None:
    """An IPv4 address stands for itself, an IPv6 address for its /64."""
    assert (source_of(one) == source_of(other)) is is_same
