"""A member by certificate on a slow radio, as real daemons: ``python -m tests.modem.members``, once."""

from __future__ import annotations

import pytest

from tests.modem.members import play
from tests.processes.harness import Stage
from tests.waiting import Stopwatch


@pytest.mark.alone
async def test_radio_of_4_kbit_s() -> None:
    """A link, a short and the longest bulletin. That one delays two heartbeats."""
    watch = Stopwatch()
    async with Stage() as stage:
        outcome = await play(stage, settle_s=5.0)
    spare_s = watch.contended_s
    assert outcome.linked_s < 6.0 + spare_s
    assert outcome.few_s < 2.0 + spare_s
    assert outcome.most_s < 4.0 + spare_s
    assert outcome.longest_gap_s < 3.5 + spare_s
