"""A fleet made by `fleet init`, run on this machine: every pair is linked."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.fleet.vehicles import RELAY, Vehicles, flying
from tests.kernel_queues import cpu_s as cpu_s_of
from uavlinkd.fleet.manifest import read_manifest

pytestmark = pytest.mark.long

DRONES = 25
"""300 pairs. Real drones have a computer each. Fifty share two busy cores so thinly that answers come too late, and
the handshakes that are tried again leave even less time for answers."""
GROUP = 10
"""Drones that start at the same time."""
PATIENCE_S = 1200.0
"""A busy machine may take this long."""
PATIENT_LINK = "[link]\nlost_after_s = 180.0\n"
"""On a busy machine a daemon may wait for its turn for longer than the usual 3 s. Lost peers are linked again,
which costs more CPU time, so that more of them are lost."""
CPU_S = 6.0
"""Processor time of one daemon until all its links are up: 1.1 s on two idle cores, more on a busy machine."""
OWN_BYTES = 96 << 20


async def test_every_pair_of_a_swarm_is_linked() -> None:
    """Each pair has a session at a limited cost, and a daemon's memory grows little with its peers."""
    async with flying(drones=DRONES, started=False) as vehicles:
        names = [member.name for member in read_manifest(vehicles.fleet).members if member.name != RELAY]
        vehicles.carry(RELAY)
        await vehicles.start(RELAY)
        for name in names:
            config = vehicles.fleet / name / f"{name}.toml"
            config.write_text(config.read_text().replace("[link]\n", PATIENT_LINK))
        for first in range(0, DRONES, GROUP):
            for name in names[first : first + GROUP]:
                vehicles.carry(name)
                await vehicles.start(name)
            async with asyncio.timeout(PATIENCE_S):
                await until_linked(vehicles)
        cpu_s = sum(map(cpu_s_of, vehicles.pids.values()))
        own_bytes = max(own_memory(pid) for pid in vehicles.pids.values())
    print(f"{DRONES} drones: {cpu_s:.1f} s of CPU time until linked, at most {own_bytes:,} bytes")
    assert cpu_s < CPU_S * DRONES
    assert own_bytes < OWN_BYTES


async def until_linked(vehicles: Vehicles) -> None:
    """Wait until each daemon reports all others that run as up."""
    running = vehicles.pids.keys() - {RELAY}
    for name in running:
        while True:
            if vehicles.up(name) >= running - {name}:
                break
            await asyncio.sleep(0.25)


def own_memory(pid: int) -> int:
    """Memory in bytes that a process does not share with others (proc(5), smaps_rollup)."""
    lines = (line.split() for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    return 1024 * sum(int(line[1]) for line in lines if line[0].startswith("Private_"))
