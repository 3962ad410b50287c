"""pymavlink's mavutil and the simulated autopilot, with nothing between them."""

from __future__ import annotations

from tests.lab.sim import scenarios
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight


async def test_it_flies_the_simulated_copter() -> None:
    """mavutil connects, reads every parameter, sets two, uploads and reads back a mission, takes off and lands."""
    scenarios.need("pymavlink.mavutil")
    async with Flight("udpin:127.0.0.1:0", AutopilotSettings(system_id=3)) as flight:
        before = {parameter.name: parameter.value for parameter in flight.autopilot.parameters.table}
        seen = await scenarios.fly_with_mavutil(f"udpout:127.0.0.1:{flight.address[1]}")
        scenarios.check(seen, system_id=3, parameters=before)
        scenarios.check_flown(flight)
