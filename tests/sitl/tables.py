"""Transfers of tables: all parameters, and a mission up and down. Lost messages are requested again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from time import monotonic
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.station import AUTOPILOT, RequestError, Station

LIST_RETRY_S = 1.5
PARAMETERS_AT_ONCE = 10
"""Missing parameters that are requested together."""
ITEM_RETRY_S = 1.0
UPLOAD_SILENCE_S = 2.0
"""The vehicle requests an item again within about this time. After it, the station repeats its last message."""
NO_INDEX = 65535
SAME_FRAMES = {mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT}
"""Names of one frame. Autopilots answer with the one or the other."""
MISSION = mavlink.MAV_MISSION_TYPE_MISSION


@dataclass(frozen=True, slots=True)
class Item:
    """An item of a mission. ``x`` and ``y`` in 1e-7 degrees, ``z`` in m."""

    command: int
    frame: int
    four: tuple[float, float, float, float]
    x: int
    y: int
    z: float

    def matches(self, other: Item) -> bool:
        """Whether an autopilot stored this item as the other: a parameter that it does not use may be NaN or 0."""
        frames = [SAME_FRAMES.get(item.frame, item.frame) for item in (self, other)]
        same = (self.command, frames[0], self.x, self.y) == (other.command, frames[1], other.x, other.y)
        pairs = [*zip(self.four, other.four, strict=True), (self.z, other.z)]
        return same and all(math.isnan(one) or math.isnan(two) or abs(one - two) < 0.01 for one, two in pairs)


async def download_parameters(station: Station, system: int, timeout_s: float = 300.0) -> dict[str, float]:
    """Request the list of parameters, then those that were lost, until all have arrived.

    Raises:
        RequestError: not all arrived in time.
    """
    by_index: dict[int, tuple[str, float]] = {}
    count = 0
    deadline = monotonic() + timeout_s
    with station.inbox(system, "PARAM_VALUE") as inbox:
        station.send(mavlink.MAVLink_param_request_list_message(system, AUTOPILOT))
        while monotonic() < deadline:
            answer = await inbox.next(LIST_RETRY_S if len(by_index) == 0 or count == 0 else ITEM_RETRY_S)
            if answer is not None:
                if answer.param_index != NO_INDEX:
                    count = answer.param_count
                    by_index[answer.param_index] = (answer.param_id, answer.param_value)
                if count and len(by_index) == count:
                    return dict(by_index.values())
                continue
            station.retries["parameters"] += 1
            missing = [index for index in range(count) if index not in by_index][:PARAMETERS_AT_ONCE]
            if not missing:
                station.send(mavlink.MAVLink_param_request_list_message(system, AUTOPILOT))
            await _request_missing(station, system, missing, by_index, inbox)
            if count and len(by_index) == count:
                return dict(by_index.values())
    raise RequestError(f"{len(by_index)} of {count} parameters within {timeout_s:.0f} s")


async def _request_missing(
    station: Station, system: int, missing: list[int], by_index: dict[int, tuple[str, float]], inbox: Any
) -> None:
    """Request parameters by index; an answer to each request, or silence, ends it."""
    while missing:
        for index in missing:
            station.send(mavlink.MAVLink_param_request_read_message(system, AUTOPILOT, b"", index))
        while missing:
            answer = await inbox.next(ITEM_RETRY_S)
            if answer is None:
                break
            if answer.param_index == NO_INDEX:
                continue
            by_index[answer.param_index] = (answer.param_id, answer.param_value)
            missing = [index for index in missing if index not in by_index]
            count = answer.param_count
            if not missing:
                missing = [index for index in range(count) if index not in by_index][:PARAMETERS_AT_ONCE]
                for index in missing:
                    station.send(mavlink.MAVLink_param_request_read_message(system, AUTOPILOT, b"", index))
        else:
            return
        return


async def upload_mission(
    station: Station, system: int, items: list[Item], timeout_s: float = 300.0, *, plan: int = MISSION
) -> None:
    """Send a mission: the vehicle requests each item, and acknowledges the whole.

    Raises:
        RequestError: the vehicle refused it, or did not acknowledge it in time.
    """
    deadline = monotonic() + timeout_s
    newest = count = mavlink.MAVLink_mission_count_message(system, AUTOPILOT, len(items), plan)
    last: Any = None
    with station.inbox(system, "MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK") as inbox:
        station.send(newest)
        while monotonic() < deadline:
            answer = await inbox.next(UPLOAD_SILENCE_S)
            if answer is None:
                station.retries["mission upload"] += 1
                station.send(newest)
            elif answer.get_type() == "MISSION_ACK":
                if answer.type == mavlink.MAV_MISSION_ACCEPTED and newest is not count:
                    return
                if answer.type == mavlink.MAV_MISSION_ERROR and newest is last:
                    station.retries["mission upload, lost acknowledgement"] += 1
                    return  # the vehicle has the whole mission, and refuses the item that was repeated
                if answer.type == mavlink.MAV_MISSION_OPERATION_CANCELLED:  # the vehicle waited too long: again
                    station.retries["mission upload, whole"] += 1
                    newest = count
                    station.send(newest)
                elif answer.type not in (mavlink.MAV_MISSION_ACCEPTED, mavlink.MAV_MISSION_INVALID_SEQUENCE):
                    raise RequestError(f"the mission was refused with {answer.type}; {station.texts[-5:]}")
            elif answer.seq < len(items):
                newest = _as_message(system, answer.seq, items[answer.seq], plan)
                last = newest if answer.seq == len(items) - 1 else None
                station.send(newest)
    raise RequestError(f"the mission was not acknowledged within {timeout_s:.0f} s")


def _as_message(system: int, sequence: int, item: Item, plan: int) -> Any:
    return mavlink.MAVLink_mission_item_int_message(
        *(system, AUTOPILOT, sequence, item.frame, item.command, int(sequence == 0), 1),
        *(*item.four, item.x, item.y, item.z, plan),
    )


async def download_mission(
    station: Station, system: int, timeout_s: float = 300.0, *, plan: int = MISSION
) -> list[Item]:
    """Request the number of items, then each item, then acknowledge.

    Raises:
        RequestError: not all items arrived in time.
    """
    deadline = monotonic() + timeout_s
    items: list[Item] = []
    count: int | None = None
    with station.inbox(system, "MISSION_COUNT", "MISSION_ITEM_INT") as inbox:
        request = mavlink.MAVLink_mission_request_list_message(system, AUTOPILOT, plan)
        station.send(request)
        while monotonic() < deadline:
            answer = await inbox.next(ITEM_RETRY_S)
            if answer is None:
                station.retries["mission download"] += 1
                station.send(request)
                continue
            if answer.get_type() == "MISSION_COUNT" and count is None:
                count = answer.count
            elif answer.get_type() == "MISSION_ITEM_INT" and answer.seq == len(items):
                four = (answer.param1, answer.param2, answer.param3, answer.param4)
                items.append(Item(answer.command, answer.frame, four, answer.x, answer.y, answer.z))
            else:
                continue
            if count is not None and len(items) >= count:
                station.send(mavlink.MAVLink_mission_ack_message(system, AUTOPILOT, 0, plan))
                return items
            request = mavlink.MAVLink_mission_request_int_message(system, AUTOPILOT, len(items), plan)
            station.send(request)
    raise RequestError(f"{len(items)} of {count} items within {timeout_s:.0f} s")
