"""What the tests of endpoints share: a daemon's stand-in, frames that can be told apart, and a measurement."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic

from pymavlink.dialects.v20 import common as mavlink

from tests.policies import TRUSTED
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic as boot_time
from uavlinkd.endpoints.ports import Endpoint, LocalPort
from uavlinkd.endpoints.udp import UdpClient
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.system.stall import StallWatch

PATIENCE_S = 60.0
"""After which what was to happen has not."""


def frame(number: int) -> bytes:
    """A genuine frame of some 30 bytes that says ``number``."""
    message = mavlink.MAVLink_named_value_int_message(number, b"number", number)
    return bytes(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))


def large_frame(number: int) -> bytes:
    """A genuine frame of 263 bytes."""
    message = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [number % 256] * 250 + [1])
    return bytes(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))


def heartbeat() -> bytes:
    """A frame that goes before others."""
    message = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    return bytes(message.pack(mavlink.MAVLink(None, srcSystem=255, srcComponent=1)))


def source(name: str) -> Source:
    """A peer that may send everything."""
    return Source(name, compile_policy(TRUSTED).incoming)


PASSES = source("peer")
"""A peer that may send everything."""


def frames_of(raws: Sequence[bytes]) -> list[Frame]:
    """Frames as the daemon reads them."""
    return split_payload(b"".join(raws), SplitCounters())


def write(endpoint: Endpoint, port: LocalPort, raws: Sequence[bytes], now: float, source: Source = PASSES) -> None:
    """Send these frames of one source to a port, as the switch does."""
    endpoint.write(port, frames_of(raws), source, now)


async def eventually(condition: Callable[[], bool]) -> None:
    """Wait until something is so.

    Raises:
        TimeoutError: where it is not.
    """
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  what is waited for is a socket's doing and sets no event
            await asyncio.sleep(0.002)


class Recorder:
    """Remembers what endpoints report."""

    def __init__(self) -> None:
        self.open: list[LocalPort] = []
        self.closed: list[LocalPort] = []
        self.batches: list[list[bytes]] = []
        """One for each call."""
        self.epochs: list[int] = []
        """Of each."""
        self.stall = StallWatch(boot_time(), lambda seconds: None)
        self.on_batch: Callable[[], None] = lambda: None

    @property
    def heard(self) -> list[bytes]:
        return [raw for batch in self.batches for raw in batch]

    def on_port_opened(self, port: LocalPort) -> None:
        self.open.append(port)

    def on_port_closed(self, port: LocalPort) -> None:
        self.open.remove(port)
        self.closed.append(port)

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        assert port in self.open, "a port speaks after it is opened and before it is closed"
        self.batches.append([each.raw for each in frames])
        self.epochs.append(epoch)
        self.on_batch()


@dataclass(frozen=True)
class Delivery:
    """What a program at a UDP endpoint got, and the longest that a batch took to get there."""

    frames: list[bytes]
    slowest_s: float
    sent: int


async def measure_udp_delivery(*others: Endpoint, batches: int = 200, frames_per_batch: int = 20) -> Delivery:
    """Write the same frames to a UDP program and to every port of the other endpoints, as the daemon does."""
    program = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    program.bind(("127.0.0.1", 0))
    program.setblocking(False)
    endpoint = UdpClient("udp", Address(*program.getsockname()), Recorder())
    endpoint.start()
    loop = asyncio.get_running_loop()
    got = bytearray()
    slowest_s = 0.0
    sent = 0
    try:
        await eventually(lambda: len(endpoint.ports) == 1)
        for number in range(batches):
            frames = [large_frame(number)] * frames_per_batch
            began = now = monotonic()
            for other in others:
                for port in other.ports:
                    write(other, port, frames, now)
            write(endpoint, endpoint.ports[0], frames, now)
            sent += sum(map(len, frames))
            async with asyncio.timeout(PATIENCE_S):
                while len(got) < sent:
                    got += await loop.sock_recv(program, 65536)
            slowest_s = max(slowest_s, monotonic() - began)
    finally:
        endpoint.close()
        program.close()
    size = len(large_frame(0))
    return Delivery([bytes(got[at : at + size]) for at in range(0, len(got), size)], slowest_s, sent // size)
