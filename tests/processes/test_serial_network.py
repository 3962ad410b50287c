"""Two linked daemons with emulated SiK modems between them, and a client at each that talks: with byte errors and
pulled plugs.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

from pymavlink.dialects.v20 import all as mavlink

from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.udp import Client, Sockaddr
from tests.samples import pack
from tests.waiting import Stopwatch, until
from uavlinkd.lab.mitm.modem import Fate, ModemEnd, ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings
from uavlinkd.mavlink.frames import SplitCounters, split_payload

SIK = ModemSettings()
INTERVAL_S = 0.1


class RadioClient:
    """A client that sends numbered commands and heartbeats, and knows what it sent."""

    def __init__(self, client: Client, into: Sockaddr, system: int) -> None:
        self.client = client
        self.into = into
        self.system = system
        self.sent: list[bytes] = []

    async def talk(self) -> None:
        """Send a heartbeat and a command each so often, without end."""
        number = 0
        while True:
            number += 1
            heartbeat = mavlink.MAVLink_heartbeat_message(2, 3, 81, number, 4, 3)
            command = mavlink.MAVLink_command_long_message(256 - self.system, 1, 400, 0, number, 1, 1, 1, 1, 1, 1)
            for message in (heartbeat, command):
                self.sent.append(pack(message, self.system, seq=len(self.sent)))
                self.client.send(self.sent[-1], self.into)
            await asyncio.sleep(INTERVAL_S)

    def received(self) -> list[bytes]:
        """All frames that came, without the notes of the daemon."""
        frames = split_payload(bytes(self.client.received), SplitCounters())
        return [frame.raw for frame in frames if frame.raw[5] == 256 - self.system]


class SerialRadio:
    """The daemons, their clients and the modems."""

    def __init__(self, ports: ModemPorts, daemons: tuple[DaemonProcess, DaemonProcess]) -> None:
        self.ports = ports
        self.vehicle, self.ground = daemons
        self.clients: tuple[RadioClient, RadioClient]

    async def both_receive(self, count: int = 4) -> None:
        """Wait until each client has received so many frames that the other sends from now on."""
        marks = [len(client.sent) for client in self.clients]
        for hearer, other, mark in zip(self.clients, self.clients[::-1], marks[::-1], strict=True):
            await hearer.client.until(lambda: len({*hearer.received()} & {*other.sent[mark:]}) >= count)  # noqa: B023

    def check(self) -> None:
        """Each client received only what the other one sent, and nothing twice."""
        for hearer, other in (self.clients, self.clients[::-1]):
            received = hearer.received()
            assert set(received) <= set(other.sent)
            assert len(set(received)) == len(received)


def connect_modems(stage: Stage, a: DaemonProcess, b: DaemonProcess, modem: ModemSettings = SIK) -> ModemPorts:
    """Give both daemons a serial network beside their addresses of each other, with modems that are not started."""
    ports = ModemPorts(PortSettings(stage.folder / "left", stage.folder / "right", modem, seed=1))
    for daemon, end in ((a, ModemEnd.LEFT), (b, ModemEnd.RIGHT)):
        network: dict[str, object] = {"name": "sik", "serial": f"{ports.settings.device(end)}:{int(modem.line_baud)}"}
        if modem.air_bits_s != SIK.air_bits_s:
            network["air_bits_s"] = int(modem.air_bits_s)
        daemon.config.setdefault("network", []).append(network)
        daemon.config["peer"][0]["addresses"].append({"network": "sik"})
    return ports


@asynccontextmanager
async def serial_radio(stage: Stage, modem: ModemSettings = SIK) -> AsyncIterator[SerialRadio]:
    """Daemons that have no other path to each other than the radio. Their clients talk."""
    vehicle, ground = stage.pair()
    for daemon in (vehicle, ground):
        daemon.config["peer"][0]["addresses"] = []
    radio = SerialRadio(connect_modems(stage, vehicle, ground, modem), (vehicle, ground))
    await radio.ports.start()
    talking: list[asyncio.Task[None]] = []
    try:
        intos = [daemon.add_endpoint("client") for daemon in (vehicle, ground)]
        radio.clients = (
            RadioClient(await stage.client(), intos[0], 1),
            RadioClient(await stage.client(), intos[1], 255),
        )
        await stage.start(vehicle, ground)
        talking = [asyncio.create_task(client.talk()) for client in radio.clients]
        yield radio
    finally:
        for task in talking:
            task.cancel()
        await radio.ports.stop()


NOISY = replace(SIK, packet_loss=0.02, byte_error_rate=0.001, byte_loss_rate=0.0005)
BACK_S = 1.0
"""Heartbeats and commands pass again this soon after the line is back, on a machine without other work."""


async def test_link_over_noisy_modems_and_a_pulled_plug(stage: Stage) -> None:
    """The handshake, heartbeats and commands pass, and again soon after the line is back. No frame is altered.

    After the return the noise may destroy a datagram or two, so the bound is twice that of a line without noise.
    """
    async with serial_radio(stage, NOISY) as radio:
        await radio.both_receive(10)
        status = await radio.ground.until(lambda status: status["peers"]["drone0"]["path"] == "serial")
        (path,) = status["peers"]["drone0"]["paths"]
        assert (path["network"], path["address"], path["is_configured"]) == ("sik", "serial", True)
        line = status["networks"]["sik"]
        assert (line["is_present"], line["addresses"], line["absent_because"]) == (True, ["serial"], None)
        assert line["serial"]["air_bits_s"] == SIK.air_bits_s
        statistics = radio.ports.link.bytes
        await until(lambda: all(statistics[end][Fate.ALTERED] for end in ModemEnd))
        await radio.ground.until(lambda status: status["networks"]["sik"]["serial"]["line_noise"] >= 1)
        for end, daemon in ((ModemEnd.LEFT, radio.vehicle), (ModemEnd.RIGHT, radio.ground)):
            radio.ports.pull(end)
            await daemon.until(lambda status: not status["networks"]["sik"]["is_present"])
            assert (await daemon.until_logged("network_disappeared"))["network"] == "sik"
            radio.ports.plug(end)
            watch = Stopwatch()
            await radio.both_receive()
            assert watch.calm_s < 2 * BACK_S + INTERVAL_S
        radio.check()
