"""``uavlinkd sim`` says where it sends, who connects, and what it sent."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.recorded import Collector
from tests.waiting import until
from uavlinkd.lab.sim.flight import SimOptions, run_sim
from uavlinkd.lab.sim.links import parse_url


@asynccontextmanager
async def sim(url: str, **options: Any) -> AsyncIterator[list[str]]:
    """The lines of a running simulator. It is interrupted at the end, as by Ctrl-C."""
    lines: list[str] = []
    running = asyncio.create_task(run_sim(SimOptions(parse_url(url), **options), lines.append))
    try:
        yield lines
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running


async def test_it_reports_a_ground_station() -> None:
    """The pilot sees that the link works. Ctrl-C ends with the counters."""
    async with Collector("udpin:127.0.0.1:0") as ground:
        async with sim(f"udpout:127.0.0.1:{ground.address[1]}", system_id=7) as lines:
            await ground.until(lambda: bool(ground.frames))
            assert lines == [
                f"copter with system ID 7, sends to {str(ground.link.url).replace('in', 'out')}; Ctrl-C ends it"
            ]
            beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 0, 3)
            ground.send(bytes(beat.pack(mavlink.MAVLink(None, 255, 190))))
            await until(lambda: "gcs connected: system_id 255 component_id 190" in lines)
        assert lines[-1].startswith("sent ")
        assert "received 1 in" in lines[-1]
