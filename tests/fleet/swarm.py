"""The cost of a swarm on one machine: a fleet by `uavlinkd fleet init`, one daemon per drone, every pair linked.

    python -m tests.fleet.swarm --drones 50

Each drone has its own loopback address, from 127.0.13.1. The exit status is 0 if all pairs were linked in time.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import FleetSettings
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlError, ask

PATIENCE_S = 120.0
LINKED_S = 60.0
"""From the first start until every pair is linked, on an idle machine."""
POLL_S = 0.25
GROUP = 10
"""Drones that start at the same time. Fifty on one busy machine have too little CPU time for all handshakes at once:
peers are lost again before the last one is linked. Real drones have a computer each."""
PATIENT_LINK = "[link]\nhandshake_after_s = 60.0\nlost_after_s = 120.0\n"
"""On a busy machine a daemon may wait for its turn for longer than the usual 3 s. Lost peers are linked again,
which costs more CPU time, so that more of them are lost."""
END_S = 120.0
"""A daemon ends within a fraction of this."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Durations in seconds. Memory in bytes, of the largest daemon."""

    drones: int
    pairs: int
    made_s: float
    """Duration of `fleet init`."""
    listening_s: float
    """From the first start until the last daemon answers. Most of it is the start of Python."""
    linked_s: float
    """From the first start until both ends of every pair report the link."""
    handshakes: int
    cpu_until_linked_s: float
    """User and system time of all daemons together."""
    own_bytes: int
    """Memory that is not shared with other processes."""
    resident_bytes: int
    idle_cpu_share: float
    """Of one core, per daemon, without any traffic."""


async def measure(drones: int, folder: Path, idle_s: float = 5.0, patience_s: float = PATIENCE_S) -> Figures:
    """Start a swarm, wait for all links, and measure its cost.

    Raises:
        TimeoutError: a pair was not linked in time.
    """
    settings = FleetSettings(
        address_plan=f"127.0.13.{{n}}:{free_port()}", drone_url=f"udpin:127.0.13.{{n}}:{free_port()}"
    )
    began = time.monotonic()
    fleet = operations.init(folder / "fleet", settings, drones, 0, 0).fleet
    made_s = time.monotonic() - began
    for member in fleet.members:
        config = folder / "fleet" / member.name / f"{member.name}.toml"
        config.write_text(config.read_text().replace("[link]\n", PATIENT_LINK))
    processes: list[asyncio.subprocess.Process] = []
    sockets = [folder / "fleet" / member.name / f"{member.name}.sock" for member in fleet.members]
    try:
        began = time.monotonic()
        with (folder / "swarm.log").open("wb") as log:
            for first in range(0, drones, GROUP):
                for member in fleet.members[first : first + GROUP]:
                    config = folder / "fleet" / member.name / f"{member.name}.toml"
                    command = end_with_parent(sys.executable, "-m", "uavlinkd", "run", "--config", str(config))
                    processes.append(await asyncio.create_subprocess_exec(*command, stdout=log, stderr=log))
                started = sockets[: len(processes)]
                async with asyncio.timeout(patience_s):
                    for socket in started:
                        await _until_answering(socket)
                    listening_s = time.monotonic() - began
                    handshakes = [await _until_linked(socket, len(started) - 1) for socket in started]
        linked_s = time.monotonic() - began
        cpu = sum(_cpu_s(process.pid) for process in processes)
        await asyncio.sleep(idle_s)
        idle = (sum(_cpu_s(process.pid) for process in processes) - cpu) / idle_s / drones
        return Figures(
            drones=drones,
            pairs=drones * (drones - 1) // 2,
            made_s=round(made_s, 2),
            listening_s=round(listening_s, 2),
            linked_s=round(linked_s, 2),
            handshakes=sum(handshakes) // 2,
            cpu_until_linked_s=round(cpu, 2),
            own_bytes=max(_memory(process.pid, "Private_Clean", "Private_Dirty") for process in processes),
            resident_bytes=max(_memory(process.pid, "Rss") for process in processes),
            idle_cpu_share=round(idle, 5),
        )
    except TimeoutError:
        print((folder / "swarm.log").read_text(errors="replace"))
        raise
    finally:
        await asyncio.gather(*map(end, processes))


async def end(process: asyncio.subprocess.Process) -> int:
    """End a daemon; its exit status. Kill it if it ignores SIGTERM."""
    if process.returncode is None:
        process.terminate()
    try:
        return await asyncio.wait_for(process.wait(), END_S)
    except TimeoutError:
        process.kill()
        return await process.wait()


async def _until_answering(socket: Path) -> None:
    while True:
        try:
            ask(socket, "status")
        except ControlError:
            await asyncio.sleep(POLL_S)
        else:
            return


async def _until_linked(socket: Path, count: int) -> int:
    """Wait until so many peers are up; the number of handshakes until then."""
    while True:
        status = ask(socket, "status", timeout_s=PATIENCE_S)
        if sum(peer["state"] == "up" for peer in status["peers"].values()) >= count:
            return sum(peer["handshakes"] for peer in status["peers"].values())
        await asyncio.sleep(POLL_S)


def _cpu_s(pid: int) -> float:
    """User and system time of a process (proc(5), stat, 14 and 15)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def _memory(pid: int, *kinds: str) -> int:
    """Memory of these kinds that a process has, in bytes (proc(5), smaps_rollup)."""
    lines = (line.split() for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    return 1024 * sum(int(line[1]) for line in lines if line[0].rstrip(":") in kinds)


def main() -> int:
    """Measure a swarm, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description="Link a swarm on this machine and measure its cost.")
    parser.add_argument("--drones", type=int, default=50, metavar="N")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="uavlinkd-swarm-") as folder:
        figures = asyncio.run(measure(options.drones, Path(folder)))
    print(json.dumps(asdict(figures), indent=1))
    return 0 if figures.linked_s < LINKED_S else 1


if __name__ == "__main__":
    sys.exit(main())
