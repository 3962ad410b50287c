"""Whatever goes wrong around a daemon, it goes on, says so in a few lines, and is soon back when it is mended."""

from __future__ import annotations

import asyncio

import pytest

from tests.faults.machine import LINES_AT_MOST
from tests.faults.network import FAULT_S
from tests.faults.run import BACK_S, FAULTS, happen, markdown, why_not
from tests.faults.talk import Outcome
from tests.needs import need
from uavlinkd.link.conditions import LINES_BURST, LINES_PER_S

Outcomes = dict[str, Outcome | BaseException]


@pytest.fixture(scope="module")
def outcomes(request: pytest.FixtureRequest) -> Outcomes:
    """Of every fault that is asked about, all at once: they take long, and mostly wait."""
    asked = {
        item.callspec.params["fault"]
        for item in request.session.items
        if isinstance(item, pytest.Function) and item.module is request.module and hasattr(item, "callspec")
    }
    reason = why_not()
    possible = [name for name in FAULTS if name in asked and not (reason and FAULTS[name].takes_root)]
    outcomes = asyncio.run(happen(possible))
    print(markdown(outcomes))
    return outcomes


@pytest.mark.parametrize("fault", FAULTS)
def test_daemon_withstands_it_and_is_back_in_time(fault: str, outcomes: Outcomes) -> None:
    """It keeps running and keeps its log short; the measured time from the fault's end is within the bound."""
    need(fault in outcomes, why_not() or "nothing")
    outcome = outcomes[fault]
    if isinstance(outcome, BaseException):
        raise outcome
    print(outcome)
    assert outcome.recovered_s < BACK_S
    # A sender with valid keys can cause a line a handshake, up to what the log grants one peer.
    of_peer = LINES_BURST + FAULT_S * LINES_PER_S if fault == "garbage" else 0
    assert outcome.lines <= LINES_AT_MOST + FAULT_S / 5 + of_peer
