"""A real daemon on loopback, and the client that is written from the whitepaper at its stations' port."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress

import pytest

from tests import waiting
from tests.kernel_queues import receive_queue
from tests.processes.frames import command_long, ground_heartbeat, heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.udp import Client as Autopilot
from tests.processes.udp import open_socket
from tests.stations.client import Client
from uavlinkd.config import keys
from uavlinkd.lab.sim.loopback_ports import free_port

pytestmark = pytest.mark.long
ARM = 400
GROUND_HEARTBEAT = ground_heartbeat()


class Tablet:
    """The client with a socket: its system answers, its software keeps what comes."""

    def __init__(self, client: Client, daemon: tuple[str, int]) -> None:
        self.client = client
        self.daemon = daemon
        self.sock = open_socket("127.0.0.1")
        self.payloads: list[bytes] = []
        self.initiations = 0
        self.answers_initiations = True
        asyncio.get_running_loop().add_reader(self.sock, self._read)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self.sock)
        self.sock.close()

    def send(self, datagram: bytes) -> None:
        self.sock.sendto(datagram, self.daemon)

    def _read(self) -> None:
        datagram = self.sock.recv(4096)
        with suppress(KeyError):  # of a session before a restart of the client
            match datagram[0]:
                case 1:
                    self.initiations += 1
                    if self.answers_initiations:
                        self.send(self.client.on_initiation(datagram))
                case 2:
                    self.client.on_response(datagram)
                    self.send(self.client.data(b""))
                case 4:
                    payload, answers = self.client.on_data(datagram)
                    self.payloads += [payload] if payload else []
                    for answer in answers:
                        self.send(answer)


class Setup:
    """One daemon with an autopilot and a station."""

    def __init__(self, stage: Stage, autopilot: Autopilot) -> None:
        self.daemon: DaemonProcess = stage.daemon("drone1")
        self.autopilot = autopilot
        self.to_autopilot = self.daemon.add_endpoint("autopilot", system_ids=[1])
        private = keys.generate_private_key()
        stage.secrets.append(private)
        keys.write_secret_file(self.daemon.folder / "stations.key", private)
        self.daemon_key = daemon_key = keys.decode_key(keys.public_key_text(private))
        port = free_port()
        self.tablet = Tablet(Client(daemon_key), ("127.0.0.1", port))
        self.daemon.config |= {
            "stations": {"private_key_file": "stations.key", "listen": f"127.0.0.1:{port}"},
            "station": [
                {
                    "name": "tablet",
                    "public_key": keys.encode_key(self.tablet.client.key),
                    "address": "10.66.0.2",
                    "role": "operator",
                    "system_ids": [255],
                }
            ],
        }

    async def connect(self, frame: bytes = GROUND_HEARTBEAT) -> None:
        """Start the daemon, and let the station show its heartbeat until a command would pass."""
        await self.daemon.start()
        await self.daemon.ready()
        self.tablet.send(self.tablet.client.initiation())
        await waiting.until(lambda: self.tablet.client.is_open)
        await self.until_commands_pass(frame)

    async def until_commands_pass(self, frame: bytes = GROUND_HEARTBEAT) -> None:
        """Send a frame that must be new until it arrives at the autopilot."""
        self.autopilot.send(heartbeat(), self.to_autopilot)
        self.autopilot.clear()
        while not self.autopilot.frames:
            self.tablet.send(self.tablet.client.udp(frame))
            await asyncio.sleep(0.05)


@pytest.fixture
async def setup() -> AsyncIterator[Setup]:
    async with Stage() as stage:
        setup = Setup(stage, await stage.client())
        yield setup
        setup.tablet.close()


async def test_vehicle_and_station_exchange_what_the_role_allows(setup: Setup) -> None:
    """The vehicle's frames come without asking; a command of the station arrives, one as another system does not."""
    await setup.connect()
    setup.autopilot.send(heartbeat(), setup.to_autopilot)
    await waiting.until(lambda: heartbeat() in setup.tablet.payloads)
    arm = command_long(ARM, 255, param1=1.0)
    setup.tablet.send(setup.tablet.client.udp(arm))
    await setup.autopilot.until(lambda: arm in setup.autopilot.frames)
    setup.tablet.send(setup.tablet.client.udp(command_long(ARM, 1, param1=1.0)))
    setup.tablet.send(setup.tablet.client.udp(heartbeat(1)))
    status = await setup.daemon.until(lambda status: "foreign_system" in str(status["endpoints"]["tablet"]))
    assert list(status["endpoints"]["tablet"]["clients"]) == ["10.66.0.2:14550"]
    assert setup.autopilot.frames.count(arm) == 1
    assert not any(frame == command_long(ARM, 1, param1=1.0) for frame in setup.autopilot.frames)


async def test_station_is_back_after_a_restart_of_the_daemon(setup: Setup) -> None:
    """The daemon initiates where the station was, and the station's system does nothing for it."""
    await setup.connect()
    await waiting.until(lambda: "127.0.0.1" in (setup.daemon.folder / "drone1.stations-state").read_text())
    await setup.daemon.kill()
    tablet = setup.tablet
    before = tablet.initiations
    await setup.daemon.start()
    await waiting.until(lambda: tablet.initiations > before)
    await setup.until_commands_pass()


async def test_station_that_answers_nothing_is_named_with_its_remedy(setup: Setup) -> None:
    """Its commands are dropped, the vehicle's reports pass, and `status` names the firewall."""
    tablet = setup.tablet
    tablet.client.answers_pings = tablet.answers_initiations = False
    await setup.daemon.start()
    await setup.daemon.ready()
    tablet.send(tablet.client.initiation())
    await waiting.until(lambda: tablet.client.is_open)
    arm = command_long(ARM, 255, param1=1.0)

    async def command() -> None:
        while True:
            tablet.send(tablet.client.udp(arm))
            setup.autopilot.send(heartbeat(), setup.to_autopilot)
            await asyncio.sleep(0.2)

    commanding = asyncio.create_task(command())
    try:
        status = await setup.daemon.until(
            lambda status: any(finding["cause"] == "station_unverified" for finding in status["findings"])
        )
    finally:
        commanding.cancel()
    (finding,) = (one for one in status["findings"] if one["cause"] == "station_unverified")
    assert "remoteip=10.66.0.1" in finding["remedy"]
    assert heartbeat() in tablet.payloads
    assert arm not in setup.autopilot.frames


async def test_errors_of_answers_to_closed_ports_do_not_stay(setup: Setup) -> None:
    """The socket would be readable for good, and the daemon busy."""
    await setup.connect()
    port = setup.tablet.daemon[1]
    for count in range(2, 20):
        with open_socket("127.0.0.1") as closed:
            for _ in range(count):
                closed.sendto(setup.tablet.client.initiation(), setup.tablet.daemon)
        await waiting.until(lambda: receive_queue(port).waiting_bytes == 0)
