"""A fleet made by `fleet init`, run on this machine: every pair is linked."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.fleet import swarm

pytestmark = pytest.mark.long

DRONES = int(os.environ.get("UAVLINKD_SWARM", "8"))
"""50 is the full test, which `.ci/run` runs: 1,225 pairs."""
PATIENCE_S = 1200.0
"""A busy machine may take this long."""
CPU_S = 6.0
"""Processor time of one daemon until all its links are up. Fifty daemons on two idle cores need 2 s each. On a busy
machine the same work takes more processor time."""


async def test_every_pair_of_a_swarm_is_linked(tmp_path: Path) -> None:
    """Each pair has a session at a limited cost, and a daemon's memory grows little with its peers."""
    figures = await swarm.measure(DRONES, tmp_path, idle_s=1.0, patience_s=PATIENCE_S)
    print(figures)
    assert figures.cpu_until_linked_s < CPU_S * DRONES
    assert figures.handshakes >= figures.pairs
    assert figures.own_bytes < 96 << 20
