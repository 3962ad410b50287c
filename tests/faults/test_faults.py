"""Whatever goes wrong around a daemon, it goes on, says so in a few lines, and is soon back when it is mended."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import pytest

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.faults import machine, network
from tests.faults.machine import LINES_AT_MOST
from tests.faults.network import FAULT_S
from tests.faults.talk import Outcome
from tests.namespaces import why_not as why_no_namespaces
from tests.needs import need
from uavlinkd.link.conditions import LINES_BURST, LINES_PER_S

AT_ONCE = 8
"""Faults that are there at the same time: mostly they wait."""
BACK_S = 2.0
"""All works again so long after the end of any fault."""


class _Stage(Stage):
    """One of several: daemons are started in turns, as that is what takes the processor's time."""

    def __init__(self, starting: asyncio.Lock) -> None:
        super().__init__()
        self._starting = starting

    async def start(self, *daemons: DaemonProcess, linked: bool = True) -> None:
        async with self._starting:
            await super().start(*daemons, linked=linked)


@dataclass(frozen=True, slots=True)
class Fault:
    what: str
    happen: Callable[[Stage], Awaitable[Outcome]]
    takes_root: bool = False


FAULTS: Mapping[str, Fault] = {
    "suspended": Fault("the process is stopped (`SIGSTOP`)", machine.suspended),
    **{
        name: Fault(fault.what, partial(network.suffer, name=name), True)
        for name, fault in network.NETWORK_FAULTS.items()
    },
    "clock_jumps": Fault("the clock leaps ten years ahead, and 54 back", machine.clock_jumps),
    "garbage": Fault("a peer seals garbage with its valid keys", machine.garbage_with_valid_keys),
}


def why_not() -> str | None:
    """What is missing here for the faults that take root; None for nothing."""
    return why_no_namespaces("nft", "tc")


async def happen(names: Iterable[str]) -> dict[str, Outcome | BaseException]:
    """Cause these faults, each for daemons of its own; returns the result of each."""
    turns, starting = asyncio.Semaphore(AT_ONCE), asyncio.Lock()

    async def one(name: str) -> Outcome:
        async with turns, _Stage(starting) as stage:
            return await FAULTS[name].happen(stage)

    chosen = list(names)
    results = await asyncio.gather(*(one(name) for name in chosen), return_exceptions=True)
    return dict(zip(chosen, results, strict=True))


def markdown(outcomes: Mapping[str, Outcome | BaseException]) -> str:
    rows = ["| fault | what the daemon did | back after | log lines |", "|---|---|--:|--:|"]
    for name, outcome in outcomes.items():
        if isinstance(outcome, Outcome):
            cells = (outcome.did, f"{outcome.recovered_s:.2f} s", str(outcome.lines))
        else:
            cells = (f"FAILED: {type(outcome).__name__}: {(str(outcome).splitlines() or [''])[0][:100]}", "", "")
        rows.append(f"| {FAULTS[name].what} | {' | '.join(cells)} |")
    return "\n".join(rows)


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
