"""A fleet that `fleet init` made, run on this machine: every pair is linked."""

from __future__ import annotations

import os
from pathlib import Path

from tests.fleet import swarm

DRONES = int(os.environ.get("UAVLINKD_SWARM", "8"))
"""50 is the full test, as `.ci/run` has it: 1,225 pairs. Most of its time is the start of a hundred Pythons."""


async def test_every_pair_of_a_swarm_is_linked(tmp_path: Path) -> None:
    """Each pair has a session within a minute, and a daemon's memory grows little with its peers."""
    figures = await swarm.measure(DRONES, tmp_path, idle_s=1.0)
    print(figures)
    assert figures.linked_s < swarm.LINKED_S
    assert figures.handshakes >= figures.pairs
    assert figures.own_bytes < 96 << 20
