"""A captured swarm member floods a daemon's serial port, and the operator's commands arrive all the same.

The bound on their delay is held in virtual time: ``tests/endpoints/test_starvation.py``.
"""

from __future__ import annotations

import pytest

from tests.daemon.harness import Stage
from tests.daemon.starvation import POLICIES, SHARE, starve
from tests.endpoints.starvation import COMMANDS, HEARTBEATS

pytestmark = pytest.mark.long

KBIT_S = 2000
QUEUED_S = 0.6
"""Half of the commands are faster than this on any machine. Behind the flood each of them would wait for a second."""


@pytest.mark.parametrize("policy", POLICIES)
async def test_operator_gets_through_a_flood_with_a_fifth_of_a_core(stage: Stage, policy: str) -> None:
    """On a small computer too, each command and each heartbeat arrives, with the role's rates and without."""
    result = await starve(stage, KBIT_S, POLICIES[policy], cpu_share=SHARE, duration_s=5.0)
    assert COMMANDS + HEARTBEATS - result.commands - result.heartbeats <= result.lost_to_waiting
    assert result.commands > 0
    # On a busy machine both wait longer. Without fair turns a command would wait for as long as the flood.
    assert result.median_added_s < max(QUEUED_S, result.flood_median_s / 2)
    assert result.flood_frames > 0
