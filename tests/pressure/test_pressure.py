"""The effect of one attacker on a daemon's other peers, with real daemons on loopback. README.md has the figures."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.kernel_queues import capacity
from tests.pressure.scene import FAIR_SHARE, PLANS, watch
from tests.processes.harness import Stage
from tests.waiting import Stopwatch

SECONDS = 2.0
AT_MOST_PER_S = 2_500.0
FULL_PER_S = 20_000.0
"""Envelopes of an insider: more than a core can handle."""
QUEUED = 0.75
"""The share of the daemon's receive buffer that the attacker may fill. The rest is room for the honest peer's
datagrams while the daemon waits for a processor, however long that takes: 20 datagrams/s are few."""

# Reasons that must be counted, and the share of a core that the daemon may use; None: all of it.
EXPECTED: dict[str, tuple[set[str], float | None]] = {
    "insider initiations": ({"group_budget_spent"}, 0.5),
    "no attack": (set(), 0.5),
    "strangers": ({"unknown_peer"}, 0.5),
    "bad certificates": ({"bad_certificate"}, 0.5),
    "spoofed initiations": ({"rate_limited", "cookie_required"}, 0.5),
    "64 kB envelopes": ({"too_long"}, 0.5),
    "agreed envelopes": ({"over_share"}, None),
    "start bytes": ({"over_share"}, None),
}


def test_every_plan_has_its_limits() -> None:
    """A new attack needs a row here."""
    assert EXPECTED.keys() == PLANS.keys()


@pytest.mark.parametrize("name", EXPECTED)
async def test_other_peers_lose_nothing(name: str) -> None:
    """Every frame arrives in both directions, ``status`` answers, a known peer links, drops have reasons.

    The attacker sends more than the daemon can handle, but never fills its receive buffer. So the kernel has no
    reason to drop an honest datagram, also while the daemon waits for a processor. On a busy machine at least half
    of the frames arrive.
    """
    reasons, share = EXPECTED[name]
    plan = PLANS[name]
    per_s = FULL_PER_S if "over_share" in reasons else min(plan.per_s, AT_MOST_PER_S)
    async with Stage() as stage:
        stopwatch = Stopwatch()
        seen = await watch(stage, replace(plan, per_s=per_s, queue_bytes=int(QUEUED * capacity())), SECONDS)
        is_busy = stopwatch.calm_s < stopwatch.elapsed_s / 2

    # A busy machine delays frames by seconds: some are too old then, and not every such loss has a counter.
    assert seen.lost <= max(seen.lost_to_waiting, seen.sent // 2 if is_busy else 0), seen
    assert seen.soon >= FAIR_SHARE * seen.sent > 0, seen
    assert seen.unanswered == 0
    assert (seen.linked_after_s is not None) == plan.with_latecomer
    assert reasons <= seen.drops.keys()
    if share is not None:
        assert seen.cpu_share < share
