"""Strangers at the stations' port, 20,000 a second: none is accepted, and peers and the station go on."""

from __future__ import annotations

import asyncio
import sys
from base64 import b64encode
from contextlib import suppress
from statistics import quantiles
from time import monotonic

import pytest

from tests.kernel_queues import cpu_s
from tests.processes.frames import frames_in, ground_heartbeat, heartbeat, numbered
from tests.processes.harness import Stage
from tests.stations.test_daemon import Setup
from uavlinkd.lab.child_processes import end_with_parent

pytestmark = pytest.mark.long
PER_S = 20_000
SECONDS = 5.0
EVERY_S = 0.02


class Talk:
    """A peer's frames to the attacked daemon's autopilot; how long each took."""

    def __init__(self, stage: Stage, setup: Setup) -> None:
        self.setup = setup
        self.ground, psk = stage.daemon("ground"), stage.psk()
        setup.daemon.add_peer(self.ground, [self.ground.address], psk, role="vehicle", system_ids=[9])
        self.ground.add_peer(setup.daemon, [setup.daemon.address], psk, role="all", system_ids="all")
        self.into = self.ground.add_endpoint("software")
        self.number = 0

    async def p99_s(self, stage: Stage, seconds: float) -> float:
        """The 99th of a hundred latencies of frames of the peer, while the station sends and receives too."""
        software, autopilot, tablet = self.client, self.setup.autopilot, self.setup.tablet
        sent: dict[bytes, float] = {}
        autopilot.clear()
        end = monotonic() + seconds
        while monotonic() < end:
            self.number += 1
            raw = numbered(self.number, 9)
            sent[raw] = monotonic()
            software.send(raw, self.into)
            autopilot.send(heartbeat(), self.setup.to_autopilot)
            tablet.send(tablet.client.udp(ground_heartbeat(self.number)))
            await asyncio.sleep(EVERY_S)
        with suppress(TimeoutError):
            await autopilot.until(lambda: set(sent) <= {raw for _, raw in autopilot.arrivals}, 2.0)
        took = [at - sent[raw] for at, raw in autopilot.arrivals if raw in sent]
        assert len(took) > len(sent) / 2
        return quantiles(took, n=100)[98]

    async def begin(self, stage: Stage) -> None:
        self.client = await stage.client()
        await self.ground.start()
        await self.ground.until_linked()
        while not any(raw == numbered(0, 9) for raw in self.setup.autopilot.frames):
            self.setup.autopilot.send(heartbeat(), self.setup.to_autopilot)
            self.client.send(numbered(0, 9), self.into)
            await asyncio.sleep(0.05)


@pytest.mark.parametrize("kind", ["macless", "mac1", "data"])
async def test_none_is_accepted(kind: str) -> None:
    """With a wrong mac1, with a right one from hosts that answer no cookie, and data of no session."""
    async with Stage() as stage:
        setup = Setup(stage, await stage.client())
        talk = Talk(stage, setup)
        await setup.connect()
        await talk.begin(stage)
        calm_s = await talk.p99_s(stage, SECONDS)
        before = await setup.daemon.status()
        key = b64encode(setup.daemon_key).decode()
        command = (
            sys.executable,
            "-m",
            "tests.stations.strangers",
            str(setup.tablet.daemon[1]),
            key,
            str(PER_S),
            kind,
        )
        pipe = asyncio.subprocess.PIPE
        attacker = await asyncio.create_subprocess_exec(*end_with_parent(*command), stdin=pipe, stdout=pipe)
        assert attacker.stdout is not None
        assert await attacker.stdout.readline() == b"ready\n"
        cpu_before_s, began = cpu_s(setup.daemon.pid), monotonic()
        attacked_s = await talk.p99_s(stage, SECONDS)
        share = (cpu_s(setup.daemon.pid) - cpu_before_s) / (monotonic() - began)
        sent = int((await attacker.communicate(b""))[0])
        after = await setup.daemon.status()
        drops = {
            name: count - before["drops"].get(name, 0)
            for name, count in after["drops"].items()
            if count > before["drops"].get(name, 0)
        }
        print(
            f"{kind}: {sent:,} sent in {SECONDS} s, p99 {1e3 * calm_s:.1f} ms before, {1e3 * attacked_s:.1f} ms"
            f" meanwhile ({attacked_s / calm_s:.2f}), {100 * share:.0f} % of a core, dropped {drops}"
        )
        assert sum(drops.values()) > 0
        assert list(after["endpoints"]["tablet"]["clients"]) == ["10.66.0.2:14550"]
        setup.tablet.payloads.clear()
        await setup.until_commands_pass()
        assert all(heartbeat() in list(frames_in(payload)) for payload in setup.tablet.payloads)
        setup.tablet.close()
