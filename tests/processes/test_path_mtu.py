"""A path with a small MTU: a router drops long datagrams, and tells the sender or does not."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.namespaces import Namespace, connect, need_namespaces, udp_socket_in
from tests.processes.frames import frames_in
from tests.processes.harness import Stage
from tests.samples import pack
from tests.waiting import until
from uavlinkd.lab.sim.loopback_ports import free_port

PORT = 5790
VEHICLE, STATION = "10.213.78.2", "10.213.79.2"
BURST = 12
SILENT = "table inet silent { chain output { type filter hook output priority 0; ip protocol icmp drop; }; }"


class Path:
    """A vehicle's daemon and a station's, a router between them, and a client of each."""

    def __init__(self, stage: Stage) -> None:
        self.router, self.hosts = Namespace(), (Namespace(), Namespace())
        self.vehicle = stage.daemon("drone0", [f"0.0.0.0:{PORT}"])
        self.station = stage.daemon("drone1", [f"0.0.0.0:{PORT}"])
        self._number = 0
        self._received = set[bytes]()

    @asynccontextmanager
    async def started(self, stage: Stage, *, is_silent: bool, mtu: int) -> AsyncIterator[None]:
        psk = stage.psk()
        self.vehicle.add_peer(self.station, [f"{STATION}:{PORT}"], psk)
        self.station.add_peer(self.vehicle, [], psk)
        self.router.open(forwards=True)
        try:
            for host, device, own in zip(self.hosts, ("veh", "gnd"), (VEHICLE, STATION), strict=True):
                host.open()
                connect(self.router, device, host)
                gateway = own.removesuffix("2") + "1"
                self.router.ip(f"address add {gateway}/24 dev {device}")
                host.ip(f"address add {own}/24 dev wan", f"route add default via {gateway}")
            if is_silent:
                self.router.nft(SILENT)
            self.set_mtu(mtu)
            for daemon, host in zip((self.vehicle, self.station), self.hosts, strict=True):
                daemon.launcher = host.launcher
            into = self.vehicle.add_endpoint("client", f"udpin:127.0.0.1:{free_port()}")
            out = self.station.add_endpoint("client", f"udpin:127.0.0.1:{free_port()}")
            with (
                udp_socket_in(self.hosts[0].path) as self._sender,
                udp_socket_in(self.hosts[1].path) as self._receiver,
            ):
                self._sender.connect(into)
                self._receiver.connect(out)
                await stage.start(self.vehicle, self.station)
                await until(self._is_served)
                yield
                for daemon in (self.vehicle, self.station):
                    await daemon.stop()
        finally:
            for namespace in (*self.hosts, self.router):
                namespace.close()

    def set_mtu(self, mtu: int) -> None:
        self.router.ip(f"link set gnd mtu {mtu}")

    async def until_limited(self, size: int) -> None:
        """Wait until the vehicle says that frames share envelopes of this length at most."""
        await self.vehicle.until(
            lambda status: (
                [one["envelope_bytes"] for one in status["peers"]["drone1"]["paths"]] == [size]
                and [one["cause"] for one in status["findings"]] == ["long_datagrams_dropped"]
            )
        )

    async def send(self, bursts: int, frames: int = BURST, each_s: float = 0.02) -> int:
        """Send bursts of LOG_DATA; returns how many frames arrived."""
        sent = list[bytes]()
        for number in range(bursts):
            burst = [self._log_data() for _ in range(frames)]
            for raw in burst:
                self._sender.send(raw)
            sent += burst
            if number % 50 == 0:
                self._receiver.send(_heartbeat(255))
            await asyncio.sleep(each_s)
        await asyncio.sleep(0.5)
        self._hears()
        return len(self._received & {*sent})

    def _log_data(self) -> bytes:
        self._number += 1
        return pack(mavlink.MAVLink_log_data_message(1, self._number, 90, [7] * 90), 1, seq=self._number % 256)

    def _is_served(self) -> bool:
        self._receiver.send(_heartbeat(255))
        self._sender.send(_heartbeat(1))
        return self._hears()

    def _hears(self) -> bool:
        with suppress(BlockingIOError):
            while True:
                self._received.update(frames_in(self._receiver.recv(2048)))
        return bool(self._received)


def _heartbeat(system: int) -> bytes:
    return pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), system)


@pytest.mark.parametrize("is_silent", [True, False])
async def test_frames_share_envelopes_that_the_path_carries(stage: Stage, is_silent: bool) -> None:
    """No frame is lost from the beginning. Without ICMP the daemon finds the length itself, and says so."""
    need_namespaces("nft")
    path = Path(stage)
    async with path.started(stage, is_silent=is_silent, mtu=1124):
        assert await path.send(60, 1) == 60
        assert await path.send(150) == 150 * BURST
        if is_silent:
            await path.until_limited(1024)


async def test_mtu_that_falls_in_flight(stage: Stage) -> None:
    """A route changes. After two seconds no frame is lost."""
    need_namespaces("nft")
    path = Path(stage)
    async with path.started(stage, is_silent=True, mtu=1500):
        assert await path.send(100) == 100 * BURST
        path.set_mtu(1124)
        await path.send(100)
        assert await path.send(150) == 150 * BURST
        await path.until_limited(1024)
