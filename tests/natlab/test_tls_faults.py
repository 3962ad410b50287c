"""Members that reach their relay by TLS: when they are linked, and what is lost when UDP or the connection fails."""

from __future__ import annotations

import asyncio

import pytest

from tests.natlab import daemons
from tests.natlab.laboratory import Laboratory, need_laboratory
from tests.natlab.pairs import make_pairs
from tests.natlab.tls_faults import FAILURES, NO_UDP, OUTAGES, fail
from tests.waiting import Stopwatch

pytestmark = [pytest.mark.alone, pytest.mark.usefixtures("_needs")]

LINKED_S = 3.0
BACK_S = 3.0
RATE = 25
"""Of commands, and of states, in each direction."""


@pytest.fixture(scope="module")
def _needs() -> None:
    need_laboratory()


async def test_pairs_without_udp_are_linked_by_tls() -> None:
    """At one end or both. No frame is lost from then on."""
    watch = Stopwatch()
    with Laboratory() as laboratory:
        pairs = make_pairs(laboratory, ("no-udp", "symmetric"), delay_s=0.01, shared=False)
        outcomes = await daemons.connect_all(pairs, laboratory.public(), direct_limit_s=0, at_once=1, tls=True)
    for pair, outcome in outcomes.items():
        assert outcome.linked_s is not None, pair.title
        assert outcome.linked_s < LINKED_S + watch.contended_s, pair.title
        assert (outcome.lost, outcome.sent > 0) == (0, True), pair.title


@pytest.mark.parametrize("fault", FAILURES)
async def test_no_command_is_lost(fault: str) -> None:
    """Lost states are those of the time in which the member did not know that its path had failed."""
    watch = Stopwatch()
    outcome = await fail(*FAILURES[fault])
    print(outcome)
    assert outcome.gap_s < BACK_S + watch.contended_s
    if outcome.gap_s < 1.9:  # a longer gap is that of a machine with other work: older commands are not sent again
        assert outcome.commands_lost == 0
    assert outcome.lost - outcome.commands_lost < 2 * RATE * (outcome.gap_s + 0.2)


async def test_silence_is_little_longer_than_the_outage() -> None:
    """A pilot's failsafe trips after 5 s. The faults happen at the same time: mostly they wait."""
    watch = Stopwatch()
    outcomes = await asyncio.gather(*(fail(outage, NO_UDP) for outage in OUTAGES.values()))
    for what, outcome in zip(OUTAGES, outcomes, strict=True):
        print(what, outcome)
        assert outcome.gap_s < outcome.away_s + 1.0 + watch.contended_s, what
