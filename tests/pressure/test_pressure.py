"""What one attacker costs a daemon's other peers, with real daemons on loopback. The figures are in README.md."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.daemon.harness import Stage
from tests.pressure.command import PLANS
from tests.pressure.scene import watch

pytestmark = pytest.mark.long

SECONDS = 2.0
AT_MOST_PER_S = 2_500.0

# Reasons that must be counted, and the part of a core that the daemon may use; None where it may use all of it.
EXPECTED: dict[str, tuple[set[str], float | None]] = {
    "insider initiations": ({"group_budget_spent"}, 0.5),
    "spoofed initiations": ({"rate_limited", "cookie_required"}, 0.5),
    "64 kB envelopes": ({"too_long"}, 0.5),
    "agreed envelopes": (set(), None),
    "start bytes": (set(), None),
}


def test_every_plan_has_its_limits() -> None:
    """A new attack gets a row here."""
    assert EXPECTED.keys() == PLANS.keys()


@pytest.mark.parametrize("name", EXPECTED)
async def test_other_peers_lose_nothing(name: str) -> None:
    """Every frame arrives both ways, ``status`` is answered, a known peer links, and the drops have their names."""
    reasons, share = EXPECTED[name]
    # At the full rate a busy machine may keep the daemon waiting for longer than its socket's buffer has room.
    plan = replace(PLANS[name], per_s=min(PLANS[name].per_s, AT_MOST_PER_S))
    async with Stage() as stage:
        seen = await watch(stage, plan, SECONDS)

    assert len(seen.latencies_s) == seen.sent > 0
    assert seen.unanswered == 0
    assert (seen.linked_after_s is not None) == plan.with_latecomer
    assert reasons <= seen.drops.keys()
    if share is not None:
        assert seen.cpu_share < share
