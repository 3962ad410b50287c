"""Helpers of the tests of endpoints: a daemon's stand-in, numbered frames, and a measurement."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from time import monotonic

from pymavlink.dialects.v20 import common as mavlink

from tests.policies import TRUSTED
from tests.waiting import PATIENCE_S, until
from uavlinkd.endpoints.ports import Endpoint, LocalPort
from uavlinkd.endpoints.stream_endpoint import StreamEndpoint
from uavlinkd.endpoints.udp import UdpClient
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic as boot_time
from uavlinkd.system.stall import StallWatch


def frame(number: int) -> bytes:
    """A genuine frame of some 30 bytes that contains ``number``."""
    message = mavlink.MAVLink_named_value_int_message(number, b"number", number)
    return bytes(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))


def large_frame(number: int) -> bytes:
    """A genuine frame of 263 bytes."""
    message = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [number % 256] * 250 + [1])
    return bytes(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))


def heartbeat() -> bytes:
    """A frame of the urgent lane."""
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


class Recorder:
    """Remembers the reports of endpoints."""

    def __init__(self) -> None:
        self.open: list[LocalPort] = []
        self.closed: list[LocalPort] = []
        self.silent: list[str] = []
        self.batches: list[list[bytes]] = []
        """One for each call."""
        self.epochs: list[int] = []
        """Of each."""
        self.stall = StallWatch(boot_time(), lambda seconds: None)
        self.on_batch: Callable[[], None] = lambda: None

    @property
    def received(self) -> list[bytes]:
        return [raw for batch in self.batches for raw in batch]

    def on_port_opened(self, port: LocalPort) -> None:
        self.open.append(port)

    def on_port_closed(self, port: LocalPort) -> None:
        self.open.remove(port)
        self.closed.append(port)

    def on_port_silent(self, port: LocalPort) -> None:
        self.silent.append(port.name)

    def on_port_active(self, port: LocalPort) -> None:
        self.silent.remove(port.name)

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        assert port in self.open, "a port speaks after it is opened and before it is closed"
        self.batches.append([frame.raw for frame in frames])
        self.epochs.append(epoch)
        self.on_batch()


def recorder(endpoint: StreamEndpoint) -> Recorder:
    """The recorder to which an endpoint reports."""
    assert isinstance(endpoint.handler, Recorder)
    return endpoint.handler


def unused_address() -> Address:
    """An address on which no process listens."""
    with socket.socket() as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(("127.0.0.1", 0))
        return Address(*sock.getsockname())


@dataclass(frozen=True)
class Delivery:
    """The frames that a UDP client got, and the median delay of a batch: a dead endpoint would delay each of them."""

    frames: list[bytes]
    usual_s: float
    sent: int


async def measure_udp_delivery(*others: Endpoint, batches: int = 200, frames_per_batch: int = 20) -> Delivery:
    """Write the same frames to a UDP client and to every port of the other endpoints, as the daemon does."""
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.bind(("127.0.0.1", 0))
    client.setblocking(False)
    endpoint = UdpClient("udp", Address(*client.getsockname()), Recorder())
    endpoint.start()
    loop = asyncio.get_running_loop()
    got = bytearray()
    delays_s: list[float] = []
    sent = 0
    try:
        await until(lambda: len(endpoint.ports) == 1)
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
                    got += await loop.sock_recv(client, 65536)
            delays_s.append(monotonic() - began)
    finally:
        endpoint.close()
        client.close()
    size = len(large_frame(0))
    return Delivery([bytes(got[at : at + size]) for at in range(0, len(got), size)], median(delays_s), sent // size)
