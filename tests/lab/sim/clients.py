"""Ground stations of other projects, as processes: each flies the vehicle at a URL, and prints its observations.

The last line has the observations as JSON.

Usage: python clients.py mavsdk|mavutil URL

It imports no module of the project, so any interpreter with the client library can run it, and a crash of the library
does not stop the tests. It uses only the library's public functions, as a user does.
"""

from __future__ import annotations

import asyncio
import functools
import json
import sys
import time
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


async def fly_with_mavsdk(url: str) -> dict[str, Any]:
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
            for sequence, (command, frame, four, x, y, z) in enumerate(PLAN)
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


def fly_with_mavutil(url: str) -> dict[str, Any]:
    """The same with pymavlink's mavutil, message by message."""
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(url, source_system=255, source_component=190, dialect="ardupilotmega")
    mav, codes = link.mav, mavutil.mavlink
    heartbeat_at = 0.0

    def expect(
        names: str | list[str],
        wanted: Callable[[Any], bool] = lambda _message: True,
        again: Any = None,
        first_after_s: float = 0.0,
    ) -> Any:
        """The next such message; what asks for it is sent again each second, as a link may lose either."""
        nonlocal heartbeat_at
        deadline, asked_at = time.monotonic() + TIMEOUT_S, time.monotonic() + first_after_s - 1
        while (now := time.monotonic()) < deadline:
            if now - heartbeat_at >= 1:
                heartbeat_at = now
                mav.heartbeat_send(codes.MAV_TYPE_GCS, codes.MAV_AUTOPILOT_INVALID, 0, 0, 0)
            if again and now - asked_at >= 1:
                asked_at = now
                again()
            message = link.recv_match(type=names, blocking=True, timeout=0.2)
            if message is not None and wanted(message):
                return message
        raise AssertionError(f"no {names} came")

    def command(number: int, *parameters: float) -> None:
        seven = [*parameters, *[0.0] * (7 - len(parameters))]
        answer = expect(
            "COMMAND_ACK",
            lambda ack: ack.command == number,
            lambda: mav.command_long_send(*target, number, 0, *seven),
        )
        assert answer.result == codes.MAV_RESULT_ACCEPTED, answer

    first = expect("HEARTBEAT", lambda message: message.autopilot != codes.MAV_AUTOPILOT_INVALID)
    target = (first.get_srcSystem(), first.get_srcComponent())
    link.target_system, link.target_component = target

    table: dict[int, tuple[str, float]] = {}
    value = expect("PARAM_VALUE", again=lambda: mav.param_request_list_send(*target))
    while True:
        table[value.param_index] = (value.param_id, value.param_value)
        missing = set(range(value.param_count)) - set(table)
        if not missing:
            break
        lacking = min(missing)
        value = expect(
            "PARAM_VALUE",
            lambda message: message.param_index < message.param_count,
            functools.partial(mav.param_request_read_send, *target, b"", lacking),
            first_after_s=0.5,
        )

    def set_parameter(name: str, wanted: float) -> float:
        answer = expect(
            "PARAM_VALUE",
            lambda message: message.param_id == name,
            lambda: mav.param_set_send(*target, name.encode(), wanted, codes.MAV_PARAM_TYPE_REAL32),
        )
        return float(answer.param_value)

    after = [set_parameter("WPNAV_SPEED_UP", 500.0), set_parameter("LAND_SPEED", 200.0)]

    def is_item(sequence: int, message: Any) -> bool:
        return bool(message.seq == sequence)

    def ask_for_upload() -> None:
        mav.mission_count_send(*target, len(PLAN), 0)

    again: Any = ask_for_upload
    while True:
        message = expect(["MISSION_REQUEST_INT", "MISSION_ACK"], again=again)
        again = None
        if message.get_type() == "MISSION_ACK":
            assert message.type == codes.MAV_MISSION_ACCEPTED, message
            break
        number, frame, four, x, y, z = PLAN[message.seq]
        mav.mission_item_int_send(*target, message.seq, frame, number, 0, 1, *four, x, y, z, 0)

    count = expect("MISSION_COUNT", again=lambda: mav.mission_request_list_send(*target, 0)).count
    plan = []
    for sequence in range(count):
        item = expect(
            "MISSION_ITEM_INT",
            functools.partial(is_item, sequence),
            functools.partial(mav.mission_request_int_send, *target, sequence, 0),
        )
        plan.append(
            (item.command, item.frame, (item.param1, item.param2, item.param3, item.param4), item.x, item.y, item.z)
        )
    mav.mission_ack_send(*target, codes.MAV_MISSION_ACCEPTED, 0)

    command(codes.MAV_CMD_SET_MESSAGE_INTERVAL, codes.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 50_000)
    command(codes.MAV_CMD_DO_SET_MODE, 1, 4)
    expect("HEARTBEAT", lambda message: message.get_srcSystem() == target[0] and message.custom_mode == 4)
    command(codes.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    command(codes.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, ALTITUDE_M)
    top = expect("GLOBAL_POSITION_INT", lambda message: message.relative_alt > 900 * ALTITUDE_M)
    command(codes.MAV_CMD_NAV_LAND)
    expect("EXTENDED_SYS_STATE", lambda message: message.landed_state == codes.MAV_LANDED_STATE_ON_GROUND)
    expect(
        "HEARTBEAT",
        lambda message: (
            message.get_srcSystem() == target[0] and not message.base_mode & codes.MAV_MODE_FLAG_SAFETY_ARMED
        ),
    )
    link.close()
    return {
        "system_id": target[0],
        "parameters": dict(table.values()),
        "set": after,
        "plan": plan,
        "top_m": top.relative_alt / 1000,
    }


if __name__ == "__main__":
    client, where = sys.argv[1:]
    seen = asyncio.run(fly_with_mavsdk(where)) if client == "mavsdk" else fly_with_mavutil(where)
    print("\n" + json.dumps(seen))
