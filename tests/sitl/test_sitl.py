"""Real autopilots at the ends of real daemons. They need a simulator: see README.md beside this file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.sitl.scenarios import Run, fly, runs
from uavlinkd.lab.sim.real_autopilot import Firmware, binary_of


def flights() -> Iterator[Any]:
    """Every run of each simulator that the environment names; a skip for each that it does not name."""
    for firmware in Firmware:
        if binary_of(firmware) is not None:
            yield from (pytest.param(run, id=str(run)) for run in runs((firmware.value,)))
        else:
            reason = f"no autopilot simulator: set UAVLINKD_{firmware.name} to its binary"
            yield pytest.param(None, id=firmware.value, marks=pytest.mark.skip(reason=reason))


@pytest.mark.sitl
@pytest.mark.parametrize("run", list(flights()))
async def test_scenario(run: Run) -> None:
    """What was sent arrives, failsafes trip when they should and only then, and control returns."""
    record = await fly(run)
    assert record.error is None, record
