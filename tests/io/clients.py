"""Helpers of the tests of endpoints: a daemon's stand-in and numbered frames."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Coroutine, Sequence

import pytest
import uvloop

from tests import samples
from tests.policies import TRUSTED
from tests.samples import file_part, frames_of, number_value, raws
from uavlinkd.io.ports import LocalPort
from uavlinkd.io.stream_endpoint import StreamEndpoint
from uavlinkd.io.tcp import TcpServer
from uavlinkd.io.udp import UdpEndpoint, UdpServer
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic as boot_time
from uavlinkd.system.stall import StallWatch

NewLoop = Callable[[], asyncio.AbstractEventLoop]
LOOPS = pytest.mark.parametrize("new_loop", [asyncio.SelectorEventLoop, uvloop.new_event_loop])
HOSTS = pytest.mark.parametrize("host", ["127.0.0.1", "::1"])


def run_in(new_loop: NewLoop, scene: Coroutine[None, None, None]) -> None:
    """Run a scene in an event loop of one of `LOOPS`."""
    with asyncio.Runner(loop_factory=new_loop) as runner:
        runner.run(scene)


def frame(number: int) -> bytes:
    """A frame of some 30 bytes that contains ``number``."""
    return number_value(number).raw


def large_frame(number: int) -> bytes:
    """A frame of 266 bytes."""
    return file_part(number, 251).raw


def heartbeat() -> bytes:
    """A frame of the urgent lane."""
    return samples.heartbeat(system=255, kind=6).raw


def source(name: str) -> Source:
    """A peer that may send everything."""
    return Source(name, Policy(TRUSTED).incoming)


PASSES = source("peer")
"""A peer that may send everything."""


def write(port: LocalPort, raws: Sequence[bytes], now: float, source: Source = PASSES) -> None:
    """Send these frames of one source to a port, as the switch does."""
    port.send(frames_of(raws), source, now, 0.0)


class Recorder:
    """Remembers the reports of endpoints."""

    def __init__(self) -> None:
        self.open: list[LocalPort] = []
        self.closed: list[LocalPort] = []
        self.silent: list[str] = []
        self.by_client: list[tuple[str, list[bytes]]] = []
        """The client's name and its frames, for each call."""
        self.epochs: list[int] = []
        self.waited: list[float] = []
        self.stall = StallWatch(boot_time(), lambda seconds: None)
        self.on_batch: Callable[[], None] = lambda: None

    @property
    def batches(self) -> list[list[bytes]]:
        return [raws for _, raws in self.by_client]

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
        self.by_client.append((port.name, raws(frames)))
        self.epochs.append(epoch)
        self.waited.append(waited_s)
        self.on_batch()


def address_of(endpoint: TcpServer | UdpEndpoint) -> tuple[str, int]:
    """The address of its socket."""
    host, port = (endpoint.listener if isinstance(endpoint, TcpServer) else endpoint._sock).getsockname()[:2]
    return host, port


def recorder(endpoint: StreamEndpoint | UdpServer) -> Recorder:
    """The recorder to which an endpoint reports."""
    assert isinstance(endpoint.handler, Recorder)
    return endpoint.handler


def unused_address() -> Address:
    """An address on which no process listens."""
    with socket.socket() as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(("127.0.0.1", 0))
        return Address(*sock.getsockname())
