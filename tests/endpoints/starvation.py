"""Measures what an operator gets through a serial line while a captured swarm member floods it.

::

    python -m tests.endpoints.starvation
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from itertools import count
from statistics import median
from typing import Any, NamedTuple
from unittest.mock import patch

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.endpoints.clients import Recorder, frames_of, source
from tests.endpoints.line import Line, LineChannel, VirtualTimeLoop
from uavlinkd.endpoints import serial, stream_endpoint
from uavlinkd.endpoints.stream_endpoint import StreamEndpoint
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.stream_splitter import StreamSplitter

BAUD = 57600
RATES_KBIT_S = (0, 64, 192, 512, 2000)
DURATION_S = 10.0
COMMANDS = 50
HEARTBEATS = 10
OPERATOR, CAPTURED = 255, 2

Make = Callable[[int], bytes]


def pack(message: Any, system: int, component: int = 1, seq: int = 0) -> bytes:
    """A frame of this system."""
    codec = mavlink.MAVLink(None, system, component)
    codec.seq = seq % 256
    return bytes(message.pack(codec))


def command(number: int) -> bytes:
    """A command of the operator that contains its number."""
    return pack(mavlink.MAVLink_command_long_message(1, 1, 176, 0, number, 1, 1, 1, 1, 1, 1), OPERATOR, seq=number)


def heartbeat(number: int) -> bytes:
    """A heartbeat of the operator."""
    return pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, number, 4, 3), OPERATOR, seq=number)


def position(number: int) -> bytes:
    """The flood: positions of the captured member."""
    message = mavlink.MAVLink_global_position_int_message(number, 1, 2, 3, 4, 5, 6, 7, 8)
    return pack(message, CAPTURED, seq=number)


def member_heartbeat(number: int) -> bytes:
    """The flood in the lane of urgent frames, with another component in each frame."""
    return pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, number, 4, 3), CAPTURED, number % 250 + 1, number)


def without_starts(make: Make) -> Make:
    """Such frames without a start byte inside, so that no separator bytes are needed behind them."""
    raws = (make(number) for number in count())
    calm = (raw for raw in raws if raw.count(0xFD) + raw.count(0xFE) == 1)
    return lambda number: next(calm)


class Result(NamedTuple):
    """The frames that arrived in spite of one flood."""

    commands: int
    heartbeats: int
    median_added_s: float
    worst_added_s: float
    flood_frames: int
    most_held: int
    flood_median_s: float = 0.0
    """Of the flood's frames that arrived, where the times at which they were sent are known."""
    lost_to_waiting: int = 0
    """Envelopes of the operator that the kernel or the daemon dropped because the daemon did not run."""


class LineEndpoint(StreamEndpoint):
    """An endpoint with one connection, to a simulated line."""

    def start(self) -> None:
        """Nothing."""


def starve(kbit_s: float, flood: Make = position) -> Result:
    """Flood a serial endpoint for DURATION_S of virtual time, beside an operator."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        loop = runner.get_loop()
        with patch.object(stream_endpoint, "monotonic", loop.time), patch.object(serial, "monotonic", loop.time):
            return runner.run(_starve(kbit_s, flood))


async def _starve(kbit_s: float, flood: Make) -> Result:
    loop = asyncio.get_running_loop()
    line = Line(BAUD / 10, loop.time)
    endpoint = LineEndpoint("serial", Recorder(), 1.0)
    port = endpoint.open(LineChannel(line), "line", loop.time(), endpoint.handler.stall.epoch).port
    operator, captured = source("operator"), source("captured")
    sent_at: dict[bytes, float] = {}

    def say(raw: bytes) -> None:
        sent_at[raw] = loop.time()
        endpoint.write(port, frames_of([raw]), operator, loop.time())

    for number in range(COMMANDS):
        loop.call_at((number + 0.37) * DURATION_S / COMMANDS, say, command(number))
    for number in range(HEARTBEATS):
        loop.call_at((number + 0.51) * DURATION_S / HEARTBEATS, say, heartbeat(number))
    size = len(flood(0))
    number = 0
    while kbit_s and loop.time() < DURATION_S:
        endpoint.write(port, frames_of([flood(number)]), captured, loop.time())
        number += 1
        await asyncio.sleep(size * 8 / (kbit_s * 1000))
    await asyncio.sleep(max(0.0, DURATION_S + 2.0 - loop.time()))
    endpoint.close()
    return _result(line, sent_at)


def _result(line: Line, sent_at: dict[bytes, float]) -> Result:
    splitter = StreamSplitter()
    arrivals = ((at, frame) for at, data in line.arrivals for frame in splitter.feed(data, at))
    return summary(arrivals, sent_at, line.bytes_per_s, line.most_held)


def summary(
    arrivals: Iterable[tuple[float, Frame]], sent_at: dict[bytes, float], bytes_per_s: float, most_held: int
) -> Result:
    """The delays of the operator's frames, which were sent at these times."""
    added: dict[bytes, float] = {}
    flooded = 0
    flood_added_s: list[float] = []
    for at, (raw, header) in arrivals:
        if header.system == CAPTURED:
            flooded += 1
            if raw in sent_at:
                flood_added_s.append(at - sent_at[raw])
        elif raw in sent_at:
            added[raw] = at - sent_at[raw] - len(raw) / bytes_per_s
    commands = {command(number) for number in range(COMMANDS)}
    of_commands = [added_s for raw, added_s in added.items() if raw in commands]
    return Result(
        len(of_commands),
        len(added) - len(of_commands),
        median(of_commands) if of_commands else 0.0,
        max(of_commands, default=0.0),
        flooded,
        most_held,
        median(flood_added_s) if flood_added_s else 0.0,
    )


def row(label: object, result: Result) -> str:
    """A row of the table."""
    return (
        f"{label:>8} {result.commands:4} of {COMMANDS} {result.heartbeats:4} of {HEARTBEATS} "
        f"{result.median_added_s * 1000:8.1f} {result.worst_added_s * 1000:8.1f} {result.flood_frames:8}"
    )


HEADING = "  kbit/s  commands heartbeats  added ms median, worst  frames of the flood"


def main() -> None:
    """Print a table for each flood, in virtual time."""
    floods = {
        "GLOBAL_POSITION_INT": position,
        "GLOBAL_POSITION_INT without start bytes inside": without_starts(position),
        "HEARTBEAT of many components": member_heartbeat,
    }
    for name, flood in floods.items():
        print(name, HEADING, sep="\n")
        for kbit_s in RATES_KBIT_S:
            print(row(kbit_s, starve(kbit_s, flood)))


if __name__ == "__main__":
    main()
