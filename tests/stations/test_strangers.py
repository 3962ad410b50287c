"""Strangers at the stations' port, 20,000 a second: none is accepted, and peers and the station go on."""

from __future__ import annotations

import asyncio
import sys
from base64 import b64encode
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from statistics import quantiles
from time import monotonic

import pytest

from tests.kernel_queues import cpu_s
from tests.processes.frames import ground_heartbeat, heartbeat, numbered
from tests.processes.harness import Stage
from tests.processes.udp import open_socket
from tests.stations.test_daemon import Setup
from uavlinkd.lab.child_processes import end_with_parent

pytestmark = [pytest.mark.long, pytest.mark.alone]
PER_S = 20_000
SECONDS = 5.0
EVERY_S = 0.02
KINDS = ("data", "macless", "mac1")
"""Data of no session, initiations with a wrong mac1, and with a right one from hosts that answer no cookie."""


class Talk:
    """A peer's frames to the attacked daemon's autopilot; how long each took."""

    def __init__(self, stage: Stage, setup: Setup) -> None:
        self.setup = setup
        self.ground, psk = stage.daemon("ground"), stage.psk()
        setup.daemon.add_peer(self.ground, [self.ground.address], psk, role="vehicle", system_ids=[9])
        self.ground.add_peer(setup.daemon, [setup.daemon.address], psk, role="all", system_ids="all")
        self.into = self.ground.add_endpoint("software")
        self.number = 0

    async def begin(self, stage: Stage) -> None:
        self.client = await stage.client()
        await self.ground.start()
        await self.ground.until_linked()
        while not any(raw == numbered(0, 9) for raw in self.setup.autopilot.frames):
            self.setup.autopilot.send(heartbeat(), self.setup.to_autopilot)
            self.client.send(numbered(0, 9), self.into)
            await asyncio.sleep(0.05)

    async def p99_s(self) -> tuple[float, float]:
        """The 99th of a hundred latencies of frames of the peer, and the daemon's share of a core meanwhile."""
        autopilot, tablet, pid = self.setup.autopilot, self.setup.tablet, self.setup.daemon.pid
        sent: dict[bytes, float] = {}
        autopilot.clear()
        used_s, began = cpu_s(pid), monotonic()
        while monotonic() < began + SECONDS:
            self.number += 1
            raw = numbered(self.number, 9)
            sent[raw] = monotonic()
            self.client.send(raw, self.into)
            autopilot.send(heartbeat(), self.setup.to_autopilot)
            tablet.send(tablet.client.udp(ground_heartbeat(self.number)))
            await asyncio.sleep(EVERY_S)
        share = (cpu_s(pid) - used_s) / (monotonic() - began)
        with suppress(TimeoutError):
            await autopilot.until(lambda: set(sent) <= {raw for _, raw in autopilot.arrivals}, 2.0)
        took = [at - sent[raw] for at, raw in autopilot.arrivals if raw in sent]
        assert len(took) > len(sent) / 2
        return quantiles(took, n=100)[98], share


@asynccontextmanager
async def strangers(kind: str, port: int, key: bytes) -> AsyncIterator[None]:
    """Datagrams of strangers, :data:`PER_S` a second, to a port of this machine."""
    command = (sys.executable, "-m", "tests.stations.strangers", str(port), b64encode(key).decode(), str(PER_S), kind)
    pipe = asyncio.subprocess.PIPE
    attacker = await asyncio.create_subprocess_exec(*end_with_parent(*command), stdin=pipe, stdout=pipe)
    assert attacker.stdout is not None
    assert await attacker.stdout.readline() == b"ready\n"
    yield
    print(f"{int((await attacker.communicate(b''))[0]):,} {kind}: ", end="")


async def test_none_is_accepted() -> None:
    """The latencies are printed beside those that as many strangers at another process's port cause."""
    async with Stage() as stage:
        setup = Setup(stage, await stage.client())
        talk, tablet = Talk(stage, setup), setup.tablet
        await setup.connect()
        await talk.begin(stage)
        for kind in KINDS:
            with open_socket("127.0.0.1") as elsewhere:
                async with strangers(kind, elsewhere.getsockname()[1], setup.daemon_key):
                    calm_s, calm_share = await talk.p99_s()
            before = (await setup.daemon.status())["drops"]
            async with strangers(kind, tablet.daemon[1], setup.daemon_key):
                p99_s, share = await talk.p99_s()
            after = await setup.daemon.status()
            drops = {name: count - before.get(name, 0) for name, count in after["drops"].items()}
            print(
                f"p99 {1e3 * calm_s:.1f} ms elsewhere, {1e3 * p99_s:.1f} ms here ({p99_s / calm_s:.2f});"
                f" {calm_share:.0%} and {share:.0%} of a core, dropped {drops}"
            )
            assert sum(drops.values()) > 0
            assert list(after["endpoints"]["tablet"]["clients"]) == ["10.66.0.2:14550"]
            talk.number += 1
            await setup.until_commands_pass(ground_heartbeat(talk.number))
        tablet.close()
