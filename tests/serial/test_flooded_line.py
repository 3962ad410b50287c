"""Captured peers flood a serial line of 57,600 baud, in virtual time: how long the frames of another peer wait."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from heapq import heappop, heappush
from itertools import count, cycle, islice
from types import SimpleNamespace
from typing import cast

import pytest
from serialx import BaseSerial

from tests.io.clients import Recorder, source
from tests.samples import ID, attitude, build, command, file_part, heartbeat, position, read
from uavlinkd.io import serial, stream_endpoint
from uavlinkd.io.serial import SerialChannel, SerialEndpoint
from uavlinkd.io.url import SerialUrl
from uavlinkd.mavlink.frames import Frame, SplitCounters, StreamSplitter
from uavlinkd.mavlink.policy.delivery import Source

BAUD = 57_600
SECONDS = 3.0
LOST_S = 9.0
Make = Callable[[int], Frame]


class Clock:
    """An event loop whose time is that of its next timer."""

    def __init__(self) -> None:
        self.now = 0.0
        self._timers: list[tuple[float, int, Callable[[], object]]] = []
        self._numbers = count()
        self.add_reader = self.remove_reader = lambda *_: None

    def call_later(self, delay_s: float, function: Callable[[], object]) -> object:
        heappush(self._timers, (self.now + delay_s, next(self._numbers), function))
        return self

    def every(self, interval_s: float, function: Callable[[], object]) -> None:
        function()
        self.call_later(interval_s, partial(self.every, interval_s, function))

    def run(self, until: float) -> None:
        while self._timers[0][0] <= until:
            self.now, _, function = heappop(self._timers)
            function()


def hostile(number: int) -> Frame:
    """A message that a receiver may lack. If it rejects the frame, it reads the last bytes as a header."""
    payload = bytes((number % 200 + 1, number // 200 % 200 + 1, 2, 2, 15)) + bytes(13) + b"\xfe\xff"
    return read(build(ID["TUNNEL"], payload, 2))


def mixed(number: int) -> Frame:
    """Messages of 12 invented components."""
    component = 1 + number % 12
    makes: list[Make] = [
        lambda n: heartbeat(n % 256, 2, component),
        lambda n: position(n, 2, component),
        partial(command, system=2),
        partial(attitude, system=2),
        file_part,
    ]
    return makes[number % len(makes)](number)


Honest = tuple[float, Sequence[Make]]
"""Frames of the honest peer that are sent together, and their interval."""


def added_s(monkeypatch: pytest.MonkeyPatch, honest: Honest, floods: Sequence[Make]) -> float:
    """The longest time by which floods of 2,000 kbit/s each delay a frame of the honest peer."""
    arrivals = []
    for those in ((), floods):
        with monkeypatch.context() as patched:
            arrivals.append(_arrivals(patched, honest, those))
    return max(arrivals[1].get(raw, LOST_S) - at for raw, at in arrivals[0].items())


def _arrivals(patched: pytest.MonkeyPatch, honest: Honest, floods: Sequence[Make]) -> dict[bytes, float]:
    """When the last byte of each frame of the honest peer has left the line."""
    clock, carried, mine, numbers = Clock(), [(0.0, b"")], set[bytes](), count()

    def write(_: int, data: bytes) -> int:
        carried.append((max(carried[-1][0], clock.now) + len(data) * 10 / BAUD, data))
        return len(data)

    patched.setattr(asyncio, "get_running_loop", lambda: clock)
    for module in (serial, stream_endpoint):
        patched.setattr(module, "monotonic", lambda: clock.now)
    patched.setattr(os, "write", write)
    device = cast(BaseSerial, SimpleNamespace(fileno=lambda: -1, num_unwritten_bytes=lambda: 0))
    endpoint = SerialEndpoint("serial", SerialUrl("line", BAUD), Recorder())
    port = endpoint.open(SerialChannel(device, BAUD), "line", 0.0, endpoint.handler.stall.epoch)

    def send(peer: Source, frames: Iterator[Frame], together: int) -> None:
        port.send(list(islice(frames, together)), peer, clock.now)

    for flood in floods:
        frames = [flood(number) for number in range(1000)]
        together = 1200 * len(frames) // sum(len(frame.raw) for frame in frames)
        clock.every(0.0048, partial(send, source("captured"), cycle(frames), together))
    operator = source("operator")

    def say() -> None:
        if clock.now < SECONDS:
            sent = [make(next(numbers)) for make in honest[1]]
            mine.update(frame.raw for frame in sent)
            send(operator, iter(sent), len(sent))

    clock.call_later(0.037, partial(clock.every, honest[0], say))
    clock.run(SECONDS + 2.0)
    splitter = StreamSplitter(SplitCounters())
    arrived = [(frame.raw, at) for at, data in carried for frame in splitter.feed(data, at)]
    return {raw: at for raw, at in arrived if raw in mine}


FLOODS: dict[str, tuple[Sequence[Make], float]] = {
    "heartbeats": ([lambda n: heartbeat(n % 256, 2, n % 250 + 1)], 0.05),
    "positions": ([lambda n: position(n, 2, n % 12 + 1)], 0.05),
    "files": ([file_part], 0.05),
    "mixed": ([mixed], 0.05),
    "mixed, of three peers": ([mixed] * 3, 0.05),
    "hostile": ([hostile], 0.07),
}
"""The floods, and the longest delay: the line carries the largest frame in 49 ms. In front of an urgent frame,
separator bytes close what a hostile one has opened."""
HONEST: dict[str, tuple[Honest, float]] = {
    "command": ((0.23, [command]), 0.0),
    "burst of commands": ((0.51, [command] * 4), 0.05),
}
"""What the honest peer sends, and how much longer it may take: each peer has an equal share during a burst."""


@pytest.mark.parametrize("flood", FLOODS)
@pytest.mark.parametrize("honest", ["command", pytest.param("burst of commands", marks=pytest.mark.long)])
def test_flood_delays_another_peer_by_a_frame(monkeypatch: pytest.MonkeyPatch, honest: str, flood: str) -> None:
    """Whatever a captured peer sends, urgent or not, of however many components: the others have their share."""
    (frames, more_s), (floods, most_s) = HONEST[honest], FLOODS[flood]
    assert added_s(monkeypatch, frames, floods) < most_s + more_s
