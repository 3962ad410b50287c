"""Findings about local endpoints of a real daemon: each absent client is absent in another way."""

from __future__ import annotations

import asyncio

from tests.daemon.frames import heartbeat
from tests.daemon.harness import Stage
from tests.link.found import findings, sending, until_found
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.causes import Cause


async def test_each_endpoint_has_its_cause(stage: Stage) -> None:
    """None of them has a client that speaks; all causes are warnings, but a device that cannot be opened."""
    a = stage.daemon("drone0")
    listener = await stage.client()
    urls = {
        Cause.NO_CLIENT: "",
        Cause.CLIENT_SILENT: f"udpout:{listener}",
        Cause.CLIENT_UNREACHABLE: f"udpout:127.0.0.1:{free_port()}",
        Cause.DEVICE_UNAVAILABLE: "serial:/dev/uavlinkd-is-not-there:57600",
    }
    for cause, url in urls.items():
        a.add_endpoint(cause.replace("_", "-"), url)
    a.add_endpoint("tcp", f"tcp:127.0.0.1:{free_port()}")
    into = a.add_endpoint("speaks")
    autopilot = await stage.client()
    await stage.start(a, linked=False)
    async with sending(autopilot, into, lambda n: [heartbeat(1, seq=n)]):
        for cause in urls:
            finding = await until_found(a, cause, cause.replace("_", "-"), "endpoint")
            assert finding["severity"] == ("fault" if cause is Cause.DEVICE_UNAVAILABLE else "warning")
        assert "(ENOENT)" in finding["text"]
        refused = await until_found(a, Cause.CLIENT_UNREACHABLE, "tcp", "endpoint")
        assert "(ECONNREFUSED)" in refused["text"]
        assert findings(await a.status(), "endpoint", "speaks") == {}


async def test_wrong_baud_rate(stage: Stage) -> None:
    """Bytes arrive that are not MAVLink."""
    a = stage.daemon("drone0")
    host, port = a.add_endpoint("autopilot", f"tcpin:127.0.0.1:{free_port()}")
    await stage.start(a, linked=False)
    _, writer = await asyncio.open_connection(host, port)

    async def babble() -> None:
        while True:
            writer.write(bytes(64))
            await asyncio.sleep(0.2)

    task = asyncio.create_task(babble())
    assert "baud rate" in (await until_found(a, Cause.GARBAGE, "autopilot", "endpoint"))["remedy"]
    task.cancel()
    writer.close()


async def test_local_client_that_may_send_nothing(stage: Stage) -> None:
    """Its policy refuses every frame, and a command by name."""
    a = stage.daemon("drone0")
    into = a.add_endpoint("autopilot", role="swarm-member", system_ids=[7])
    autopilot = await stage.client()
    await stage.start(a, linked=False)
    async with sending(autopilot, into, lambda n: [heartbeat(1, seq=n)]):
        assert "system_ids" in (await until_found(a, Cause.ALL_REFUSED, "autopilot", "endpoint"))["text"]
