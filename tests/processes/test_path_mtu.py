"""A path with a small MTU: long datagrams are dropped, and the sender is told or not."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest

from tests.namespaces import need_namespaces, udp_socket_in
from tests.processes.frames import frames_in, heartbeat
from tests.processes.harness import Stage
from tests.processes.two_hosts import ONLY, TwoHosts, interface_of
from tests.samples import log_data
from tests.waiting import until

BURST = 12
INTERFACE = interface_of(ONLY)


class Clients:
    """A client of the vehicle's daemon, which sends a log, and one of the station's, which receives it."""

    def __init__(self, hosts: TwoHosts) -> None:
        self.hosts = hosts
        self._number = 0
        self._received = set[bytes]()

    @asynccontextmanager
    async def started(self, stage: Stage) -> AsyncIterator[None]:
        into, out = (daemon.add_endpoint("log") for daemon in (self.hosts.vehicle, self.hosts.ground))
        namespaces = (host.path for host in self.hosts.hosts)
        with udp_socket_in(next(namespaces)) as self._sender, udp_socket_in(next(namespaces)) as self._receiver:
            self._sender.connect(into)
            self._receiver.connect(out)
            await stage.start(self.hosts.vehicle, self.hosts.ground)
            await until(self._is_served)
            yield

    async def send(self, bursts: int, frames: int = BURST, each_s: float = 0.02) -> int:
        """Send bursts of LOG_DATA; returns how many frames arrived."""
        sent = list[bytes]()
        for number in range(bursts):
            for _ in range(frames):
                self._number += 1
                sent.append(log_data(self._number).raw)
                self._sender.send(sent[-1])
            if number % 50 == 0:
                self._receiver.send(heartbeat(255))
            await asyncio.sleep(each_s)
        await asyncio.sleep(0.5)
        self._hears()
        return len(self._received & {*sent})

    def _is_served(self) -> bool:
        self._receiver.send(heartbeat(255))
        self._sender.send(heartbeat(1))
        return self._hears()

    def _hears(self) -> bool:
        with suppress(BlockingIOError):
            while True:
                self._received.update(frames_in(self._receiver.recv(2048)))
        return bool(self._received)


async def until_limited(hosts: TwoHosts, size: int) -> None:
    """Wait until the vehicle says that frames share envelopes of this length at most."""
    await hosts.vehicle.until(
        lambda status: [one["envelope_bytes"] for one in status["peers"]["drone1"]["paths"]] == [size]
    )


@pytest.mark.parametrize("is_silent", [True, False])
async def test_frames_share_envelopes_that_the_path_carries(stage: Stage, is_silent: bool) -> None:
    """No frame is lost from the beginning. Without an error of the kernel the daemon finds the length itself."""
    need_namespaces()
    async with TwoHosts(stage, (ONLY,)) as hosts:
        hosts.hosts[is_silent].ip(f"link set {INTERFACE} mtu 1124")
        clients = Clients(hosts)
        async with clients.started(stage):
            assert await clients.send(60, 1) == 60
            assert await clients.send(150) == 150 * BURST
            if is_silent:
                await until_limited(hosts, 1024)


async def test_mtu_that_falls_in_flight(stage: Stage) -> None:
    """A route changes. After two seconds no frame is lost."""
    need_namespaces()
    async with TwoHosts(stage, (ONLY,)) as hosts:
        clients = Clients(hosts)
        async with clients.started(stage):
            assert await clients.send(100) == 100 * BURST
            hosts.hosts[1].ip(f"link set {INTERFACE} mtu 1124")
            await clients.send(100)
            assert await clients.send(150) == 150 * BURST
            await until_limited(hosts, 1024)
