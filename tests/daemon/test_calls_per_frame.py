"""How many Python functions in how many files run for one frame, from the loop's callback to ``sendto``.

Two real daemons carry it.

A call costs 0.05 to 0.1 µs on its own, and more where caches are cold. The limits keep the path of a frame short.
C functions are not counted.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from asyncio import Handle
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tests.daemon_pair import ANY_PORT, are_linked, attitude, config
from tests.io.clients import address_of
from tests.processes.udp import Client, open_client
from tests.waiting import until
from uavlinkd.daemon.daemon import Daemon
from uavlinkd.io.udp import UdpEndpoint
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.system.addresses import Address

MOST_FUNCTIONS = 8
MOST_FILES = 6
FRAMES = 60
APART_S = 0.003
"""Longer than a socket counts as busy: each frame is read alone."""


class CallCounter:
    """Counts calls of Python functions from the loop's callback to each ``sendto``, by the port that sends."""

    def __init__(self) -> None:
        self.paths: dict[int, Counter[tuple[str, ...]]] = {}
        self._names: list[str] = []

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        """What ``sys.setprofile`` calls."""
        if event == "call":
            if frame.f_back is not None and frame.f_back.f_code is Handle._run.__code__:
                self._names.clear()
            self._names.append(f"{Path(frame.f_code.co_filename).stem}.{frame.f_code.co_qualname}")
        elif event == "c_call" and argument.__name__ == "sendto" and isinstance(argument.__self__, socket.socket):
            port = argument.__self__.getsockname()[1]
            self.paths.setdefault(port, Counter())[tuple(self._names)] += 1

    def usual_path(self, port: int) -> tuple[str, ...]:
        """The functions that ran most often before a datagram from this port."""
        return self.paths[port].most_common(1)[0][0]


class Scene:
    """A client at ``udpin`` of the left daemon, and a client that the right daemon sends to by ``udpout``."""

    left: Daemon
    right: Daemon
    client: Client
    ground: Client

    async def start(self) -> None:
        """Start everything; returns when the daemons are linked."""
        self.client, self.ground = await open_client(), await open_client()
        ground = NetworkUrl(EndpointKind.UDPOUT, Address(*self.ground.address))
        self.right = Daemon(config("right", ground))
        await self.right.start()
        called = tuple(self.right.parts.peer_sockets.addresses)
        self.left = Daemon(config("left", NetworkUrl(EndpointKind.UDPIN, ANY_PORT), called))
        await self.left.start()
        await until(lambda: are_linked(self.left, self.right))

    async def stop(self) -> None:
        """Stop everything."""
        await self.left.stop()
        await self.right.stop()
        self.client.close()
        self.ground.close()
        await asyncio.sleep(0)

    async def carry(self, first: int) -> None:
        """Frames of the client, one after the other, until the ground station has them."""
        endpoint = endpoint_of(self.left)
        for number in range(first, first + FRAMES):
            raw = attitude(number)
            self.client.send(raw, address_of(endpoint))
            await self.ground.until_received(raw)
            await asyncio.sleep(APART_S)


def endpoint_of(daemon: Daemon) -> UdpEndpoint:
    """Its only endpoint."""
    (endpoint,) = daemon.parts.local.endpoints
    assert isinstance(endpoint, UdpEndpoint)
    return endpoint


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    """Two daemons that are linked."""
    scene = Scene()
    await scene.start()
    yield scene
    await scene.stop()


async def test_calls_per_frame(scene: Scene) -> None:
    """On flows that are remembered, with roles, each direction stays within its limit."""
    await scene.carry(0)
    counter = CallCounter()
    sys.setprofile(counter)
    try:
        await scene.carry(FRAMES)
    finally:
        sys.setprofile(None)
    (link_address,) = scene.left.parts.peer_sockets.addresses
    from_client = counter.usual_path(link_address.port)
    from_peer = counter.usual_path(address_of(endpoint_of(scene.right))[1])
    for path in (from_client, from_peer):
        assert len(path) <= MOST_FUNCTIONS, "\n".join(path)
        assert len({name.partition(".")[0] for name in path}) <= MOST_FILES, "\n".join(path)
