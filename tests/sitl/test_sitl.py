"""Real autopilots at the ends of real daemons. They need a simulator: see README.md beside this file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.sitl.scenarios import Run, fly, runs
from tests.sitl.simulators import Firmware, RealAutopilotError, binary_of


def flights() -> Iterator[Any]:
    """Every run of each simulator that the environment names; a skip for each that it does not name.

    The error of a wrong name is a parameter: raised here, it would break the collection of all tests.
    """
    for firmware in Firmware:
        try:
            binary = binary_of(firmware)
        except RealAutopilotError as error:
            yield pytest.param(error, id=firmware.value)
            continue
        if binary is not None:
            yield from (pytest.param(run, id=str(run)) for run in runs(firmware.value))
        else:
            reason = f"no autopilot simulator: set UAVLINKD_{firmware.name} to its binary"
            yield pytest.param(None, id=firmware.value, marks=pytest.mark.skip(reason=reason))


@pytest.mark.sitl
@pytest.mark.parametrize("run", list(flights()))
async def test_scenario(run: Run | RealAutopilotError) -> None:
    """What was sent arrives, failsafes trip when they should and only then, and control returns."""
    if isinstance(run, RealAutopilotError):
        raise run
    record = await fly(run)
    print(record)
    assert record.error is None, record
