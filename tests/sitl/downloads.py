"""The parameters and a log, unsigned and then signed: frames of a sender must not overtake one another on any link.

pymavlink judges as a ground station does: by its count of lost frames, and by its check of signatures.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Sequence
from dataclasses import replace
from time import monotonic
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink

from tests.processes.frames import sender_of
from tests.sitl.ledger import SETTLED_S, source_of
from tests.sitl.pilots import Pilot
from tests.sitl.station import AUTOPILOT, RequestError
from tests.sitl.tables import download_parameters
from tests.sitl.transfers import (
    Figures,
    FlightError,
    check_log,
    download_log,
    give_key,
    largest,
    list_logs,
    new_key,
)
from tests.sitl.world import World

LOG_BYTES = 1_000_000
LOG_S = 120.0
"""A direct link takes a fifteenth of it."""


async def downloads(world: World, pilot: Pilot) -> Figures:
    """Fly for a log; then download the parameters and its first part, twice."""
    station, system = world.station, pilot.system
    await pilot.request_streams()
    await pilot.take_off()
    await pilot.return_and_land()
    log = largest(await list_logs(station, system))
    log = replace(log, size_bytes=min(log.size_bytes, LOG_BYTES))
    key, clock = new_key()
    rows: list[Figures] = []
    for is_signed in (False, True):
        if is_signed:
            await give_key(world, mavlink.MAVLink_setup_signing_message(system, AUTOPILOT, list(key), clock))
            station.sign_with(key, clock + 1000)
        wanted: dict[str, Awaitable[Any]] = {
            "parameters": download_parameters(station, system, LOG_S),
            "log": download_log(station, system, log, LOG_S),
        }
        for what, download in wanted.items():
            first, began, result = len(station.received), monotonic(), None
            try:
                result = await download
            except RequestError as error:
                print(error)
            seconds = monotonic() - began
            await asyncio.sleep(SETTLED_S)
            frames = [passing.frame for passing in station.received[first:] if sender_of(passing.frame) == system]
            figures = await asyncio.to_thread(judged, frames, (key, clock) if is_signed else None)
            rows.append(
                {"signed": is_signed, "what": what, "complete": result is not None, "seconds": round(seconds, 1)}
                | figures
            )
            if what == "log" and result is not None:
                await asyncio.to_thread(check_log, world.vehicles[0].simulator.folder, result)
    for row in rows:
        if not row["complete"] or row["overtaken"] or row["packet_loss_percent"] or row["rejected"]:
            raise FlightError(
                f"the {'signed' if row['signed'] else 'unsigned'} {row['what']}: {row}", {"downloads": rows}
            )
    return {"downloads": rows}


def judged(frames: Sequence[bytes], signing: tuple[bytes, int] | None = None) -> Figures:
    """The order of frames as pymavlink's ground station sees it, and by their sequence numbers alone.

    ``signing``: key and clock. A frame with an older timestamp than the one before it is rejected, and then missing.
    """
    station = mavutil.mavfile(None, "station", input=False)
    codec = mavlink.MAVLink(None)
    if signing is not None:
        codec.signing.secret_key, codec.signing.timestamp = signing
    station.mav = codec
    newest: dict[tuple[int, int], int] = {}
    overtaken = rejected = 0
    for frame in frames:
        source, number = source_of(frame), frame[2] if frame[0] == 0xFE else frame[4]
        is_late = (number - newest.setdefault(source, number - 1)) % 256 > 128
        overtaken += is_late
        newest[source] = newest[source] if is_late else number
        try:
            station.post_message(codec.decode(bytearray(frame)))
        except mavlink.MAVError:
            rejected += 1
    return {
        "frames": len(frames),
        "overtaken": overtaken,
        "packet_loss_percent": round(station.packet_loss(), 1),
        "rejected": rejected,
    }
