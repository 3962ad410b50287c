"""The core alone, timed."""

from __future__ import annotations

import pytest

from uavlinkd.core.suites import SUITES
from uavlinkd.lab.evaluation.pair import LinkChoice
from uavlinkd.lab.evaluation.timing_core import measure_core


@pytest.mark.parametrize("number", SUITES)
@pytest.mark.parametrize("confidential", [False, True])
def test_every_suite_carries_a_frame_between_two_nodes(number: int, confidential: bool) -> None:
    """The steps add up to the total, and the frame was delivered."""
    record = measure_core(LinkChoice(SUITES[number], 1024, confidential))
    steps = [record.number(f"{name}_s") for name in ("initiate", "respond", "finish", "confirm", "frame")]
    assert record.is_ok
    assert all(step > 0 for step in steps)
    assert record.number("total_s") == pytest.approx(sum(steps))
