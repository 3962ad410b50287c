"""NATs that forget, networks that die, a member that roams, a relay that is killed: the link is back soon."""

from __future__ import annotations

import pytest

from tests.natlab import namespaces
from tests.natlab.faults import FAULTS, Outcome, play
from tests.natlab.laboratory import Laboratory
from tests.needs import need
from tests.waiting import Stopwatch

pytestmark = [pytest.mark.alone, pytest.mark.long]
BACK_S = 2.0
MOVED_S = 4.0
"""A relay at another address is lost first; then its name is resolved, once a second."""
CRITICAL = "one of two networks dies, critical frames"


async def outcome_of(fault: str, limit_s: float) -> Outcome:
    """The link must be back in time."""
    reason = namespaces.why_not()
    need(reason is None, reason or "")
    watch = Stopwatch()
    with Laboratory() as laboratory:
        outcome = await play(FAULTS[fault], laboratory)
    print(outcome)
    assert outcome.back_s < limit_s + watch.contended_s
    return outcome


@pytest.mark.parametrize("fault", [name for name in FAULTS if name != CRITICAL])
async def test_link_is_back_soon(fault: str) -> None:
    """Frames were lost meanwhile, so there was a fault; or none was sent."""
    outcome = await outcome_of(fault, MOVED_S if "address" in fault else BACK_S)
    assert 0 < outcome.lost < outcome.sent or outcome.sent == 0


async def test_no_critical_frame_is_lost_when_one_of_two_networks_dies() -> None:
    """Copies go along both, to two handles of one relay."""
    outcome = await outcome_of(CRITICAL, BACK_S)
    assert outcome.lost == 0
    assert outcome.sent > 100
