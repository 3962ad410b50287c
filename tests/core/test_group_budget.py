"""Group work: the budget of all peers, and the shares of sources and peers in it."""

from __future__ import annotations

from uavlinkd.core import constants as c
from uavlinkd.core.group_budget import GroupBudget, GroupShare

DEAREST = 100


def spent(budget: GroupBudget, share: GroupShare, source: str, now: float = 0.0) -> int:
    """How many handshakes of the dearest suite are admitted at once."""
    count = 0
    while budget.take(share, source, DEAREST, now):
        count += 1
    return count


def test_a_peer_has_its_share_from_all_sources_together() -> None:
    """Two at once, then one in five seconds, wherever its initiations come from."""
    budget, share = GroupBudget(0.0), GroupShare(0.0)

    assert [spent(budget, share, source) for source in "abc"] == [2, 0, 0]
    assert not budget.take(share, "d", DEAREST, 4.9)
    assert budget.take(share, "d", DEAREST, 5.0)


def test_a_source_has_its_share_of_all_peers() -> None:
    """Half of the budget: one host with recordings of many peers leaves the rest."""
    budget = GroupBudget(0.0)

    assert sum(spent(budget, GroupShare(0.0), "loud") for _ in range(30)) == c.GROUP_WORK_PER_SOURCE_BURST // DEAREST
    assert spent(budget, GroupShare(0.0), "quiet") == 2


def test_all_together_have_a_bound() -> None:
    """Many peers from many sources: the burst, then the rate."""
    budget = GroupBudget(0.0)

    first = sum(spent(budget, GroupShare(0.0), f"host {number}") for number in range(50))
    assert first == c.GROUP_WORK_BURST // DEAREST
    later = sum(spent(budget, GroupShare(0.0), f"host {number}", 10.0) for number in range(50))
    assert later == 10 * c.GROUP_WORK_PER_S // DEAREST


def test_what_is_refused_spends_nothing() -> None:
    """A refusal by one share leaves the others as they were."""
    budget, tired = GroupBudget(0.0), GroupShare(0.0)
    spent(budget, tired, "a")
    total = budget._total._tokens
    for source in ("a", "b"):
        assert not budget.take(tired, source, DEAREST, 0.0)
    assert budget._total._tokens == total

    for _ in range(10):
        spent(budget, GroupShare(0.0), "a")
    unused, total = GroupShare(0.0), budget._total._tokens
    assert not budget.take(unused, "a", DEAREST, 0.0)
    assert (budget._total._tokens, unused.anywhere._tokens) == (total, c.GROUP_WORK_PER_PEER_BURST)
