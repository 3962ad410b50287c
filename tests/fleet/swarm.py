"""A swarm on one machine: what `uavlinkd fleet init` makes, one daemon a drone, every pair linked; and what it costs.

    python -m tests.fleet.swarm --drones 50

The drones are on loopback addresses of their own, 127.0.13.1 and up. The exit status is 0 where all pairs were linked
in time.
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

from tests.daemon.harness import free_port
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.fleet import operations as work
from uavlinkd.fleet.manifest import Settings

PATIENCE_S = 120.0
LINKED_S = 60.0
"""Every pair is linked so long after the first daemon was started."""
POLL_S = 0.25
END_S = 20.0
"""A daemon that was told to end does so within a fraction of this."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Seconds; bytes of memory that is each daemon's own, and with what it shares (the largest daemon's)."""

    drones: int
    pairs: int
    made_s: float
    """By `fleet init`."""
    listening_s: float
    """From the first start until the last daemon answers: mostly the start of Python."""
    linked_s: float
    """From the first start until every pair is linked, as both ends say."""
    handshakes: int
    cpu_until_linked_s: float
    """Of all daemons, user and system, with the processes that read their files."""
    own_bytes: int
    resident_bytes: int
    idle_cpu_share: float
    """Of one core, for each daemon, once all are linked and nobody speaks."""


async def measure(drones: int, folder: Path, idle_s: float = 5.0) -> Figures:
    """Start a swarm, wait for all links, and see what it needs.

    Raises:
        TimeoutError: some pair was not linked in time.
    """
    settings = Settings(address_plan=f"127.0.13.{{n}}:{free_port()}", drone_url=f"udpin:127.0.13.{{n}}:{free_port()}")
    began = time.monotonic()
    fleet = work.init(folder / "fleet", settings, drones, 0, 0).fleet
    made_s = time.monotonic() - began
    processes: list[asyncio.subprocess.Process] = []
    sockets = [folder / "fleet" / each.name / f"{each.name}.sock" for each in fleet.members]
    try:
        began = time.monotonic()
        with (folder / "swarm.log").open("wb") as log:
            for member in fleet.members:
                config = folder / "fleet" / member.name / f"{member.name}.toml"
                command = (sys.executable, "-m", "uavlinkd", "run", "--config", str(config))
                processes.append(await asyncio.create_subprocess_exec(*command, stdout=log, stderr=log))
        async with asyncio.timeout(PATIENCE_S):
            for socket in sockets:
                await _until_answering(socket)
            listening_s = time.monotonic() - began
            handshakes = [await _until_linked(socket, drones - 1) for socket in sockets]
            linked_s = time.monotonic() - began
        cpu = sum(_cpu_s(each.pid) for each in processes)
        await asyncio.sleep(idle_s)
        idle = (sum(_cpu_s(each.pid) for each in processes) - cpu) / idle_s / drones
        return Figures(
            drones=drones,
            pairs=drones * (drones - 1) // 2,
            made_s=round(made_s, 2),
            listening_s=round(listening_s, 2),
            linked_s=round(linked_s, 2),
            handshakes=sum(handshakes) // 2,
            cpu_until_linked_s=round(cpu, 2),
            own_bytes=max(_memory(each.pid, "Private_Clean", "Private_Dirty") for each in processes),
            resident_bytes=max(_memory(each.pid, "Rss") for each in processes),
            idle_cpu_share=round(idle, 5),
        )
    except TimeoutError:
        print((folder / "swarm.log").read_text(errors="replace"))
        raise
    finally:
        await asyncio.gather(*map(end, processes))


async def end(process: asyncio.subprocess.Process) -> int:
    """End a daemon, whether it still runs or not; its exit status. One that does not listen is killed."""
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


async def _until_linked(socket: Path, peers: int) -> int:
    """Wait until every peer is up; how many handshakes that took."""
    while True:
        status = ask(socket, "status", timeout_s=PATIENCE_S)
        states = [each["state"] for each in status["peers"].values()]
        if states == ["up"] * peers:
            return sum(each["handshakes"] for each in status["peers"].values())
        await asyncio.sleep(POLL_S)


def _cpu_s(pid: int) -> float:
    """User and system time of a process and of its ended children, who read its file (proc(5), stat, 14 to 17)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def _memory(pid: int, *kinds: str) -> int:
    """Bytes of these kinds that a process has (proc(5), smaps_rollup)."""
    lines = (line.split() for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    return 1024 * sum(int(line[1]) for line in lines if line[0].rstrip(":") in kinds)


def main() -> int:
    """Measure, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description="Link a swarm on this machine, and say what it takes.")
    parser.add_argument("--drones", type=int, default=50, metavar="N")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="uavlinkd-swarm-") as folder:
        figures = asyncio.run(measure(options.drones, Path(folder)))
    print(json.dumps(asdict(figures), indent=1))
    return 0 if figures.linked_s < LINKED_S else 1


if __name__ == "__main__":
    sys.exit(main())
