"""MAVSDK as a process: it flies the vehicle at a URL, and prints its observations as JSON in the last line.

Usage: python clients.py URL [ITEMS]

ITEMS: the least number of items of the mission.

It imports no module of the project, so any interpreter with the client library can run it, and a crash of the library
does not stop the tests. It uses only the library's public functions, as a user does.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from contextlib import aclosing
from typing import Any

TIMEOUT_S = 240.0
ALTITUDE_M = 3.0

# (command, frame, parameters, latitude and longitude in 1e-7 degrees, altitude in m). Item 0 is home, as ArduPilot's.
# Whole millionths of a degree, because MAVProxy writes no more.
PLAN = [
    (16, 0, (0.0, 0.0, 0.0, 0.0), 473977420, 85455940, 488.0),
    (22, 3, (0.0, 0.0, 0.0, 0.0), 473977420, 85455940, 12.0),
    (16, 3, (0.0, 2.0, 0.0, 0.0), 473979990, 85458880, 15.5),
    (19, 3, (3.0, 0.0, 0.0, 0.0), 473981110, 85457770, 14.25),
    (20, 2, (0.0, 0.0, 0.0, 0.0), 0, 0, 0.0),
]


async def fly_with_mavsdk(url: str, least: int = 0) -> dict[str, Any]:
    """Connect, read and set parameters, exchange a mission, fly up and down: MAVSDK 4 or later."""
    from mavsdk.asyncio import Configuration, Mavsdk
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
    from mavsdk.asyncio.plugins.param import ParamAsync
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
    from mavsdk.component_type import ComponentType
    from mavsdk.plugins.mission_raw import MissionItem

    async def first(stream: Any, wanted: Callable[[Any], bool]) -> Any:
        async with asyncio.timeout(TIMEOUT_S), aclosing(stream):
            async for value in stream:
                if wanted(value):
                    return value
        raise AssertionError("the stream has ended")

    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as sdk:
        await sdk.add_any_connection(url.replace(":", "://", 1))
        system = await sdk.first_autopilot(TIMEOUT_S)
        assert system is not None, "no autopilot was found"
        parameters, action = ParamAsync(system), ActionAsync(system)
        missions, telemetry = MissionRawAsync(system), TelemetryAsync(system)
        every = await parameters.get_all_params()
        table = {param.name: param.value for param in [*every.int_params, *every.float_params]}
        await parameters.set_param_float("WPNAV_SPEED_UP", 500.0)
        await parameters.set_param_int("LAND_SPEED", 200)
        after = [await parameters.get_param_float("WPNAV_SPEED_UP"), await parameters.get_param_int("LAND_SPEED")]

        items = [
            MissionItem(sequence, frame, command, int(sequence == 0), 1, *four, x, y, z, 0)
            for sequence, (command, frame, four, x, y, z) in enumerate(PLAN + [PLAN[2]] * (least - len(PLAN)))
        ]
        await missions.upload_mission(items)
        back = await missions.download_mission()
        plan = [
            (item.command, item.frame, (item.param1, item.param2, item.param3, item.param4), item.x, item.y, item.z)
            for item in back
        ]

        await action.set_takeoff_altitude(ALTITUDE_M)
        await action.arm()
        await first(telemetry.subscribe_armed(), bool)
        await action.takeoff()
        await first(telemetry.subscribe_in_air(), bool)
        top = await first(
            telemetry.subscribe_position(), lambda position: position.relative_altitude_m > 0.9 * ALTITUDE_M
        )
        await action.land()
        await first(telemetry.subscribe_in_air(), lambda in_air: not in_air)
        await first(telemetry.subscribe_armed(), lambda armed: not armed)
        return {
            "system_id": await system.get_system_id(),
            "parameters": table,
            "set": after,
            "plan": plan,
            "top_m": top.relative_altitude_m,
        }


if __name__ == "__main__":
    print("\n" + json.dumps(asyncio.run(fly_with_mavsdk(sys.argv[1], *map(int, sys.argv[2:])))))
