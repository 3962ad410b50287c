"""A small fleet with an authority behind NATs, as ``python -m tests.natlab --members`` makes it."""

from __future__ import annotations

import pytest

from tests.natlab.laboratory import Laboratory, need_laboratory
from tests.natlab.members import Fleet, Scenario
from tests.processes.harness import Stage
from tests.waiting import Stopwatch

pytestmark = pytest.mark.alone

JOINED_S, SPREAD_S = 5.0, 2.0


@pytest.mark.parametrize("is_swarm", [False, True], ids=["star", "swarm"])
async def test_vehicle_joins_and_is_revoked(is_swarm: bool) -> None:
    """A new vehicle touches one machine. No frame of it is delivered where its revocation is known."""
    need_laboratory()
    with Laboratory() as laboratory:
        async with Stage() as stage:
            fleet = Fleet(laboratory, stage, Scenario(3, is_swarm))
            await fleet.start()
            watch = Stopwatch()
            joined = await fleet.join()
            assert joined.since_ready_s < JOINED_S + watch.contended_s
            watch = Stopwatch()
            spread = await fleet.publish()
            assert spread.to_last_s < SPREAD_S + watch.contended_s
            watch = Stopwatch()
            revocation = await fleet.revoke(joined.vehicle)
            assert revocation.to_last_s < SPREAD_S + watch.contended_s
            assert revocation.frames_before > 0
            assert revocation.frames_after == 0
