"""Scenarios on the ground: parameters, a mission of 100 items, a log, signing. What was lost is requested again."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.pilots import Pilot
from tests.sitl.station import AUTOPILOT, RequestError, Station
from tests.sitl.tables import download_mission, download_parameters, upload_mission
from tests.sitl.world import World

LOG_BYTES = 90
"""In one LOG_DATA message."""
SILENCE_S = 1.0


@dataclass(frozen=True, slots=True)
class Log:
    """An entry of the vehicle's list of logs."""

    number: int
    size_bytes: int


async def list_logs(station: Station, system: int, timeout_s: float = 60.0) -> list[Log]:
    """The logs on the vehicle, the oldest first. Raises RequestError if no complete list arrived in time."""
    deadline = monotonic() + timeout_s
    with station.inbox(system, "LOG_ENTRY") as inbox:
        logs: dict[int, Log] = {}
        while monotonic() < deadline:
            station.send(mavlink.MAVLink_log_request_list_message(system, AUTOPILOT, 0, 0xFFFF))
            while (entry := await inbox.next(2 * SILENCE_S)) is not None:
                if entry.num_logs == 0:
                    return []
                logs[entry.id] = Log(entry.id, entry.size)
                if len(logs) == entry.num_logs:
                    return [logs[number] for number in sorted(logs)]
    raise RequestError(f"no list of logs within {timeout_s:.0f} s")


async def download_log(station: Station, system: int, log: Log, timeout_s: float = 600.0) -> bytes:
    """Request a whole log, then each run of parts that did not arrive.

    Raises:
        RequestError: not all parts arrived in time.
    """
    deadline = monotonic() + timeout_s
    count = -(-log.size_bytes // LOG_BYTES)
    parts: list[bytes | None] = [None] * count
    first = 0
    with station.inbox(system, "LOG_DATA") as inbox:
        while first < count and monotonic() < deadline:
            end = next((part for part in range(first, count) if parts[part] is not None), count)
            station.retries["log"] += (first, end) != (0, count)
            wanted_bytes = min(end * LOG_BYTES, log.size_bytes) - first * LOG_BYTES
            station.send(
                mavlink.MAVLink_log_request_data_message(
                    system, AUTOPILOT, log.number, first * LOG_BYTES, wanted_bytes
                )
            )
            while None in parts[first:end] and (data := await inbox.next(SILENCE_S)) is not None:
                if data.id == log.number and data.ofs % LOG_BYTES == 0 and data.ofs // LOG_BYTES < count:
                    parts[data.ofs // LOG_BYTES] = bytes(data.data[: data.count])
                    if data.ofs // LOG_BYTES == end - 1:
                        break  # the last part of the run: what is missing now was lost
            first = next((part for part in range(first, count) if parts[part] is None), count)
    station.send(mavlink.MAVLink_log_request_end_message(system, AUTOPILOT))
    if first < count:
        raise RequestError(f"part {first} of {count} of a log is missing after {timeout_s:.0f} s")
    return b"".join(part for part in parts if part is not None)


Figures = dict[str, Any]

ITEMS = 100
FLIGHT_LOG_BYTES = 100_000
"""The log of a flight is longer."""
SIGNING_SINCE_S = 1_420_070_400
"""The clock of MAVLink's signatures starts in 2015."""


class FlightError(AssertionError):
    """An assertion about a flight does not hold. The message is short; the figures are for the record."""

    def __init__(self, message: str, figures: Figures) -> None:
        super().__init__(message)
        self.figures = figures


async def timed(action: Awaitable[Any]) -> tuple[float, Any]:
    """The seconds that an action took, and its result."""
    began = monotonic()
    result = await action
    return round(monotonic() - began, 3), result


async def counted(world: World, act: Callable[[], Awaitable[Figures]]) -> Figures:
    """Perform an action while frames are counted. On a clean link no frame may be lost or altered.

    Raises:
        FlightError: one was.
    """
    measurement = await world.measure()
    retries = +world.station.retries
    figures = await act()
    figures["retries"] = dict(world.station.retries - retries)
    figures["frames"] = await measurement.end()
    if not world.condition.radio and not figures["frames"]["exact"]:
        raise FlightError(differences(figures["frames"]), figures)
    return figures


def differences(frames: Figures) -> str:
    """What happened to frames between the two ends, for people."""
    return "; ".join(
        f"{way}: {frames[way][fault]:,} of {frames[way]['sent']:,} frames {fault}"
        for way in ("down", "up")
        for fault in ("lost", "altered", "duplicated", "reordered")
        if frames[way][fault]
    )


async def parameters_and_mission(world: World, pilot: Pilot) -> Figures:
    """Download all parameters, send a mission of 100 items, and read it back."""
    station, system = world.station, pilot.system
    await pilot.request_streams()

    async def act() -> Figures:
        parameters_s, parameters = await timed(download_parameters(station, system))
        start = pilot.place
        items = pilot.mission(*(start.moved(number % 10, number // 10, 20.0) for number in range(ITEMS)))[:ITEMS]
        up_s, _ = await timed(upload_mission(station, system, items))
        down_s, back = await timed(download_mission(station, system))
        first = 1 if pilot.kind.has_home_item else 0  # the vehicle replaces item 0 by its home position
        assert len(back) == ITEMS
        differing = [pair for pair in list(zip(items, back, strict=True))[first:] if not pair[0].matches(pair[1])]
        assert not differing, differing[:2]
        return {
            "parameters": len(parameters),
            "parameters_s": parameters_s,
            "mission_up_s": up_s,
            "mission_down_s": down_s,
        }

    return await counted(world, act)


async def whole_log(world: World, pilot: Pilot) -> Figures:
    """Download a log: equal byte for byte to the simulator's file."""
    station, system, folder = world.station, pilot.system, world.vehicles[0].simulator.folder
    await pilot.request_streams()
    await pilot.take_off()  # the log begins when the motors start
    await pilot.return_and_land()

    async def act() -> Figures:
        log = largest(await list_logs(station, system))
        log_s, data = await timed(download_log(station, system, log))
        await asyncio.to_thread(check_log, folder, data)
        return {"log_bytes": len(data), "log_s": log_s, "log_kb_s": round(len(data) / log_s / 1000, 1)}

    return await counted(world, act)


def largest(logs: list[Log]) -> Log:
    """The largest log."""
    assert logs, "the vehicle has no log"
    return max(logs, key=lambda log: log.size_bytes)


def check_log(folder: Path, data: bytes) -> None:
    """Assert that a log is as long as that of a flight, and equals a file in a folder."""
    assert len(data) > FLIGHT_LOG_BYTES, (
        f"the log has {len(data):,} bytes, that of a flight more than {FLIGHT_LOG_BYTES:,}"
    )
    assert holds(folder, data), "no file of the simulator begins with this log"


def holds(folder: Path, data: bytes) -> bool:
    """Whether a log file in a folder begins with these bytes. A file that is being written may be longer."""
    for path in folder.rglob("*"):
        if path.suffix.lower() in (".bin", ".ulg") and path.is_file() and path.stat().st_size >= len(data):
            with path.open("rb") as file:
                if file.read(len(data)) == data:
                    return True
    return False


def new_key() -> tuple[bytes, int]:
    """A signing key and the clock at its begin, in 10 us since 2015."""
    return os.urandom(32), int((asyncio.get_running_loop().time() + SIGNING_SINCE_S) * 1e5)


async def give_key(world: World, setup: Any) -> None:
    """Send the vehicle its signing key on its maintenance port, and wait until its frames are signed."""
    station = world.station
    await world.maintain(bytes(setup.pack(mavlink.MAVLink(None, station.system, 190))))
    seen = len(station.received)
    await station.until(
        lambda: any(is_signed(passing.frame) for passing in station.received[seen:]), 30.0, "a signed frame"
    )


async def signing(world: World, pilot: Pilot) -> Figures:
    """Give the vehicle a signing key on its maintenance port, then exchange signed frames only.

    The daemons withhold SETUP_SIGNING, and pass signed frames unaltered: the vehicle ignores an unsigned command.
    """
    station, system = world.station, pilot.system
    await pilot.request_streams()
    key, clock = new_key()
    setup = mavlink.MAVLink_setup_signing_message(system, AUTOPILOT, list(key), clock)

    async def refused() -> Figures:
        station.send(setup)
        await asyncio.sleep(2.0)
        return {}

    before = await counted(world, refused)
    withheld = sum(n for what, n in before["frames"]["withheld"].items() if what.startswith("SETUP_SIGNING"))
    if world.daemons and withheld != 1:
        raise FlightError(f"the daemons withheld {withheld} SETUP_SIGNING, not 1", before)
    await give_key(world, setup)
    ignored = await is_ignored(world, system)
    station.sign_with(key, clock + 1000)

    async def act() -> Figures:
        begin = len(station.received), len(world.vehicles[0].tap.to_autopilot)
        seconds, parameters = await timed(download_parameters(station, system))
        place = pilot.place
        items = pilot.mission(*(place.moved(number, 0.0, 20.0) for number in range(20)))
        await upload_mission(station, system, items)
        await pilot.take_off()
        await pilot.return_and_land()
        received = station.received[begin[0] :]
        sent = world.vehicles[0].tap.to_autopilot[begin[1] :]
        return {
            "parameters": len(parameters),
            "parameters_s": seconds,
            "signed_down": sum(is_signed(passing.frame) for passing in received),
            "unsigned_down": sum(not is_signed(passing.frame) for passing in received),
            "signed_up": sum(is_signed(passing.frame) for passing in sent),
            "bad_signatures": station.bad_signatures,
        }

    figures = await counted(world, act)
    for wrong in ("bad_signatures", "unsigned_down"):
        if figures[wrong]:
            raise FlightError(f"{figures[wrong]:,} frames: {wrong}", figures)
    assert ignored, "the vehicle accepted an unsigned request"
    return figures | {"setup_signing_withheld": withheld, "unsigned_request_ignored": ignored}


async def is_ignored(world: World, system: int) -> bool:
    """Whether the vehicle leaves an unsigned request unanswered for 3 s."""
    with world.station.inbox(system, "PARAM_VALUE") as inbox:
        world.station.send(mavlink.MAVLink_param_request_read_message(system, AUTOPILOT, b"", 0))
        return await inbox.next(3.0) is None


def is_signed(frame: bytes) -> bool:
    """Whether a frame has a signature."""
    return frame[0] == 0xFD and bool(frame[2] & 1)
