"""How many Python functions in how many files run for one frame, from the loop's callback to ``sendto``.

Two real daemons carry it, along one path, two, or a relay, which is a third one.

A call costs 0.05 to 0.1 µs on its own, and more where caches are cold. The limits keep the path of a frame short.
C functions are not counted.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from asyncio import Handle
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tests.daemon_pair import ANY_PORT, PRIVATE, are_linked, attitude, config
from tests.io.clients import address_of
from tests.processes.udp import Client, open_client
from tests.waiting import until
from uavlinkd.config.model import Config, PeerAddress, RelayConfig, RelayServer
from uavlinkd.daemon.daemon import Daemon
from uavlinkd.io.udp import UdpEndpoint
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.protocol.constants import FEATURE_RECORDS
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.path import RELAY_HOST
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.relay.forwarding import MemberSettings
from uavlinkd.system.addresses import Address

MOST = {
    "one path": [(8, 6), (8, 6)],
    "two paths": [(16, 10), (29, 11)],
    "a relay": [(19, 14), (6, 4), (32, 14)],
}
"""Functions and files at the sending end, at the relay and at the receiving end. The aim is 8 functions in 6 files on
one path, and 12 on several."""
RELAY_KEY = Secret(bytes([3]) * 32)
RELAY_LINK = Link(features=FEATURE_RECORDS)
AMPLE_BITS_S = 1_000_000_000
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
    """A client at ``udpin`` of the left daemon, and a client that the right daemon sends to by ``udpout``.

    ``paths``: along so many paths, each to a port of its own. ``is_relayed``: along a relay, the third daemon.
    """

    left: Daemon
    right: Daemon
    client: Client
    ground: Client

    def __init__(self, paths: int, *, is_relayed: bool) -> None:
        self._paths = paths
        self.relay = Daemon(relay_config()) if is_relayed else None

    async def start(self) -> None:
        """Start everything; returns when the daemons are linked, and all paths work."""
        self.client, self.ground = await open_client(), await open_client()
        relays: tuple[Address, ...] = ()
        if self.relay is not None:
            await self.relay.start()
            relays = tuple(self.relay.parts.peer_sockets.addresses)
        ground = NetworkUrl(EndpointKind.UDPOUT, Address(*self.ground.address))
        right = replace(config("right", ground), listen=(ANY_PORT,) * self._paths)
        self.right = Daemon(along(right, relays))
        await self.right.start()
        called = () if relays else tuple(self.right.parts.peer_sockets.addresses)
        self.left = Daemon(along(config("left", NetworkUrl(EndpointKind.UDPIN, ANY_PORT), called), relays))
        await self.left.start()
        await until(lambda: are_linked(self.left, self.right))
        links = self.left.parts.links["right"], self.right.parts.links["left"]
        await until(lambda: all(sum(one.works for one in link.peer.paths.states) == self._paths for link in links))

    async def stop(self) -> None:
        """Stop everything."""
        await self.left.stop()
        await self.right.stop()
        if self.relay is not None:
            await self.relay.stop()
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


def relay_config() -> Config:
    """A daemon that is a relay, and carries no frames of its own."""
    members = (PeerSettings(name, KeyPair(private).public, None, RELAY_LINK) for name, private in PRIVATE.items())
    return replace(
        config("left", NetworkUrl(EndpointKind.UDPIN, ANY_PORT)),
        name="relay",
        private_key=RELAY_KEY,
        public_key=KeyPair(RELAY_KEY.reveal()).public,
        endpoints=(),
        peers=(),
        relay_server=RelayServer(tuple(MemberSettings(member, 2, AMPLE_BITS_S) for member in members), AMPLE_BITS_S),
    )


def along(config: Config, relays: tuple[Address, ...]) -> Config:
    """A configuration whose peer is reached along a relay at these addresses, if there are any."""
    if not relays:
        return config
    settings = PeerSettings(f"{RELAY_HOST}relay", KeyPair(RELAY_KEY.reveal()).public, None, RELAY_LINK)
    relay = RelayConfig(settings, tuple(map(PeerAddress, relays)))
    return replace(config, relays=(relay,), peers=tuple(replace(peer, relays=("relay",)) for peer in config.peers))


@pytest.mark.parametrize(
    "way", [pytest.param(name, marks=() if name == "one path" else pytest.mark.long) for name in MOST]
)  # in a busy run, what waits for its place in the order takes other functions
async def test_calls_per_frame(way: str) -> None:
    """On flows that are remembered, with roles, a frame passes no more functions than before."""
    scene, counter = Scene(2 if way == "two paths" else 1, is_relayed=way == "a relay"), CallCounter()
    await scene.start()
    try:
        await scene.carry(0)
        sys.setprofile(counter)
        try:
            await scene.carry(FRAMES)
        finally:
            sys.setprofile(None)
        senders = [daemon for daemon in (scene.left, scene.relay) if daemon is not None]
        ports = [daemon.parts.peer_sockets.addresses[0].port for daemon in senders]
        ports.append(address_of(endpoint_of(scene.right))[1])
        for path, most in zip(map(counter.usual_path, ports), MOST[way], strict=True):
            count = len(path), len({name.partition(".")[0] for name in path})
            assert count[0] <= most[0], "\n".join(path)
            assert count[1] <= most[1], "\n".join(path)
    finally:
        await scene.stop()
