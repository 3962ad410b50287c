"""MAVProxy and the simulated autopilot, with nothing between them."""

from __future__ import annotations

from pathlib import Path

from tests.lab.sim import scenarios
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight


async def test_it_flies_the_simulated_copter(tmp_path: Path) -> None:
    """MAVProxy connects, reads every parameter, sets two, uploads and reads back a mission, takes off and lands."""
    scenarios.need("MAVProxy")
    async with Flight("udpin:127.0.0.1:0", AutopilotSettings(system_id=3)) as flight:
        before = {parameter.name: parameter.value for parameter in flight.autopilot.parameters.table}
        url = f"udpout:127.0.0.1:{flight.address[1]}"
        seen = await scenarios.fly_with_mavproxy(url, tmp_path, flight)
        scenarios.check(seen, system_id=3, parameters=before)
        scenarios.check_flown(flight)
