"""``uavlinkd sim`` says where it sends, who connects, and what it sent."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.recorded import Collector
from tests.waiting import until
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import run_sim
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.system.addresses import Address


@asynccontextmanager
async def sim(url: NetworkUrl, system_id: int) -> AsyncIterator[list[str]]:
    """The lines of a running simulator. It is interrupted at the end, as by Ctrl-C."""
    lines: list[str] = []
    running = asyncio.create_task(run_sim(url, AutopilotSettings(system_id=system_id), None, lines.append))
    try:
        yield lines
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running


async def test_it_reports_a_ground_station() -> None:
    """The pilot sees that the link works. Ctrl-C ends with the counters."""
    port = free_port()
    async with Collector(EndpointKind.UDPIN, port) as ground:
        url = NetworkUrl(EndpointKind.UDPOUT, Address("127.0.0.1", port))
        async with sim(url, system_id=7) as lines:
            await ground.until(lambda: bool(ground.frames))
            assert lines == [f"copter with system ID 7, sends to {url}; Ctrl-C ends it"]
            beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 0, 3)
            ground.send(bytes(beat.pack(mavlink.MAVLink(None, 255, 190))))
            await until(lambda: "gcs connected: system_id 255 component_id 190" in lines)
        assert lines[-1].startswith("sent ")
        assert "received 1 in" in lines[-1]
