"""All faults, several at a time, and the table of their results."""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass

from tests.compose.test_namespaces import can_make_namespaces
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.faults import machine, network
from tests.faults.talk import Outcome

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
    """One thing that goes wrong."""

    what: str
    """For the table."""
    happen: Callable[[Stage], Awaitable[Outcome]]
    takes_root: bool = False


FAULTS: Mapping[str, Fault] = {
    "suspended": Fault("the process is stopped (`SIGSTOP`)", machine.suspended),
    "descriptors": Fault("no file descriptors (`RLIMIT_NOFILE`)", machine.descriptors, True),
    "buffers_full": Fault("no room in the socket's buffer (`EAGAIN`)", network.buffers_full, True),
    "firewall": Fault("a firewall forbids sending (`EPERM`)", network.firewall, True),
    "route_prohibited": Fault("the route is prohibited (`EACCES`)", network.route_prohibited, True),
    "route_gone": Fault("network unreachable: the route is removed", network.route_gone, True),
    "interface_down": Fault("the interface is down", network.interface_down, True),
    "interface_gone": Fault("the interface and its address are deleted", network.interface_gone, True),
    "name_service_gone": Fault("no name server, the peer given by name", machine.name_service_gone, True),
    "name_service_silent": Fault("a name server that answers nothing", machine.name_service_silent, True),
    "recording_disk_full": Fault("the disk for recordings is full", machine.recording_disk_full, True),
    "log_disk_full": Fault("the disk for the log is full", machine.log_disk_full, True),
    "clock_jumps": Fault("the clock leaps ten years ahead, and 54 back", machine.clock_jumps),
    "garbage": Fault("a peer seals garbage with its valid keys", machine.garbage_with_valid_keys),
}


def why_not() -> str | None:
    """What is missing here for the faults that take root; None for nothing."""
    if not can_make_namespaces():
        return "root, and iproute2 with network namespaces"
    missing = [name for name in ("nft", "tc", "unshare", "mount") if shutil.which(name) is None]
    return f"{', '.join(missing)} (Debian: nftables, iproute2, util-linux)" if missing else None


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
    """The table."""
    rows = ["| fault | what the daemon did | back after | log lines |", "|---|---|--:|--:|"]
    for name, outcome in outcomes.items():
        if isinstance(outcome, Outcome):
            cells = (outcome.did, f"{outcome.recovered_s:.2f} s", str(outcome.lines))
        else:
            cells = (f"FAILED: {type(outcome).__name__}: {(str(outcome).splitlines() or [''])[0][:100]}", "", "")
        rows.append(f"| {FAULTS[name].what} | {' | '.join(cells)} |")
    return "\n".join(rows)


def fault_seconds() -> str:
    """How long each lasted, for the table's head."""
    return os.environ.get("UAVLINKD_FAULT_S", f"{network.FAULT_S:g}")
