"""Members that reach their relay through real HTTP proxies."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from tests.processes.frames import GROUND_SYSTEM, heartbeat
from tests.processes.harness import Stage
from tests.processes.test_relay_by_tls import Scene, carrying
from tests.processes.web_servers import PASSWORD, USER, WebServer, running, squid, tinyproxy
from tests.waiting import PATIENCE_S
from uavlinkd.lab.sim.loopback_ports import free_port

Make = Callable[[Path, int], WebServer]


async def talk_both_ways(scene: Scene) -> None:
    """Frames of each client arrive at the other. The first ones may be sent without a connection."""
    autopilot, before = await scene.stage.client(), len(scene.pilot.received)
    async with asyncio.timeout(PATIENCE_S):
        while len(scene.pilot.received) == before or not autopilot.received:
            autopilot.send(heartbeat(), scene.into)
            if scene.pilot.sources:
                scene.pilot.send(heartbeat(GROUND_SYSTEM), scene.pilot.sources[-1])
            await asyncio.sleep(0.1)


async def until_connections(scene: Scene, count: int) -> None:
    await scene.relay.until(lambda status: status["relay"]["https"]["connections"] == count)


async def check_restart(scene: Scene, server: WebServer) -> None:
    """All connections of the relay go through the server: they end with it, and come back."""
    await server.stop()
    await until_connections(scene, 0)
    await server.start()
    await until_connections(scene, 2)
    await talk_both_ways(scene)


async def test_member_through_a_proxy(stage: Stage) -> None:
    """The environment of the member names the proxy, which asks for a password."""
    scene = Scene(stage)
    port = int(scene.url.rpartition(":")[2].partition("/")[0])
    async with running(tinyproxy, stage.folder / "proxy", port) as server:
        user = f"{USER}:{PASSWORD}@"
        for member in (scene.drone, scene.ground):
            member.environ = {"HTTPS_PROXY": f"http://{user}127.0.0.1:{server.port}", "NO_PROXY": ""}
        await scene.start([scene.url], [scene.url])
        await talk_both_ways(scene)
        assert await carrying(scene.drone) == scene.url
        await check_restart(scene, server)


async def test_proxy_that_refuses(stage: Stage) -> None:
    """The log of the member has the status of the proxy."""
    scene = Scene(stage)
    async with running(squid, stage.folder / "proxy", free_port()) as server:
        scene.drone.environ = {"HTTPS_PROXY": f"http://127.0.0.1:{server.port}", "NO_PROXY": ""}
        scene.drone.config["relay"][0]["addresses"] = [scene.url]
        await stage.start(scene.relay, scene.drone, linked=False)
        await scene.drone.until_logged("relay_not_connected", reason="proxy_403")
    assert await scene.connections() == 0
