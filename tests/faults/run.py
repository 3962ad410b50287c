"""All faults, several at a time, and the table of their results."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.faults import machine, network
from tests.faults.talk import Outcome
from tests.namespaces import why_not as why_no_namespaces

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
