"""Real daemons on emulated SiK modems: byte errors, lost bytes, attacks on the line, and a plug that is pulled."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.daemon.harness import Stage
from tests.daemon.serial_pair import without_ip
from tests.daemon.udp import Client, Sockaddr
from tests.waiting import Stopwatch, until
from uavlinkd.lab.mitm.line_attacks import LINE_ATTACKS, parse_line_attack
from uavlinkd.lab.mitm.modem import Fate, ModemEnd, ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings
from uavlinkd.mavlink.frames import SplitCounters, split_payload

SIK = ModemSettings()
NOISY = replace(SIK, packet_loss=0.02, byte_error_rate=0.001, byte_loss_rate=0.0005)
INTERVAL_S = 0.1
BACK_S = 1.0
"""Heartbeats and commands pass again this soon after the line is back, on a machine without other work."""


class Voice:
    """A client that sends numbered commands and heartbeats, and knows what it sent."""

    def __init__(self, client: Client, into: Sockaddr, system: int) -> None:
        self.client = client
        self.system = system
        self.sent: list[bytes] = []
        self._into = into
        self._codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self._number = 0
        self._target = 256 - system
        self._task = asyncio.create_task(self._talk())

    async def _talk(self) -> None:
        while True:
            self._number += 1
            for message in (
                mavlink.MAVLink_heartbeat_message(2, 3, 81, self._number, 4, 3),
                mavlink.MAVLink_command_long_message(self._target, 1, 400, 0, self._number, 1, 1, 1, 1, 1, 1),
            ):
                frame = bytes(message.pack(self._codec))
                self.sent.append(frame)
                self.client.send(frame, self._into)
            await asyncio.sleep(INTERVAL_S)

    def stop(self) -> None:
        """Say no more."""
        self._task.cancel()


class Radio:
    """Two linked daemons with modems between them, and a client at each."""

    def __init__(self, ports: ModemPorts, voices: tuple[Voice, Voice]) -> None:
        self.ports = ports
        self.voices = voices

    async def both_receive(self, count: int = 4) -> None:
        """Wait until each client has received so many frames that the other sends from now on."""
        marks = [len(voice.sent) for voice in self.voices]
        for voice, other, mark in zip(self.voices, self.voices[::-1], marks[::-1], strict=True):
            await voice.client.until(lambda: _common(voice, other, mark) >= count)  # noqa: B023  awaited at once

    def check(self) -> None:
        """Each client received only what the other one sent, and nothing twice."""
        for voice, other in (self.voices, self.voices[::-1]):
            received = [frame for frame in _received(voice) if frame[5] == other.system]
            assert set(received) <= set(other.sent)
            assert len(set(received)) == len(received)


def _received(voice: Voice) -> list[bytes]:
    return [frame.raw for frame in split_payload(bytes(voice.client.received), SplitCounters())]


def _common(voice: Voice, other: Voice, mark: int) -> int:
    return len(set(_received(voice)) & set(other.sent[mark:]))


Start = Callable[[ModemSettings], Awaitable[Radio]]


@pytest.fixture
async def radio(stage: Stage) -> AsyncIterator[Start]:
    """Starts daemons on modems with these settings. They are stopped at the end."""
    started: list[Radio] = []

    async def start(settings: ModemSettings) -> Radio:
        ports = ModemPorts(PortSettings(stage.folder / "left", stage.folder / "right", settings, seed=1))
        await ports.start()
        vehicle, ground = stage.pair()
        without_ip(vehicle, ground)
        clients = await stage.client(), await stage.client()
        intos: list[Sockaddr] = []
        for daemon, device in ((vehicle, "left"), (ground, "right")):
            daemon.config["network"] = [{"name": "sik", "serial": f"{stage.folder / device}:57600"}]
            daemon.config["peer"][0]["addresses"] = [{"network": "sik"}]
            intos.append(daemon.add_endpoint("client"))
        started.append(Radio(ports, (Voice(clients[0], intos[0], 1), Voice(clients[1], intos[1], 255))))
        await stage.start(vehicle, ground)
        return started[-1]

    yield start
    for one in started:
        for voice in one.voices:
            voice.stop()
        await one.ports.stop()


async def test_noisy_modems_and_a_pulled_plug(radio: Start) -> None:
    """Handshake, heartbeats and commands pass, and again soon after the line is back. No frame is altered.

    After the return the noise may destroy a datagram or two, so the bound is twice that of a line without noise.
    """
    pair = await radio(NOISY)
    await pair.both_receive(10)
    statistics = pair.ports.link.bytes
    await until(lambda: all(statistics[end][Fate.ALTERED] for end in ModemEnd))
    for end in ModemEnd:
        pair.ports.pull(end)
        lost = pair.ports.link.bytes[end.other][Fate.WRITTEN]
        await until(lambda: pair.ports.link.bytes[end.other][Fate.WRITTEN] > lost + 200)  # noqa: B023
        pair.ports.plug(end)
        watch = Stopwatch()
        await pair.both_receive()
        print(f"{end}: {watch.elapsed_s:.2f} s after the return ({watch.calm_s:.2f} s calm)")
        assert watch.calm_s < 2 * BACK_S + INTERVAL_S
    pair.check()


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(LINE_ATTACKS))
async def test_attack_on_the_line(radio: Start, name: str) -> None:
    """It delivers nothing, and the link works when it ends."""
    pair = await radio(SIK)
    await pair.both_receive()
    interval_s = 5 if name == "line-hold" else 0.2
    attack = parse_line_attack(f"{name},interval_s={interval_s},hold_s=3")
    pair.ports.change_attacks([attack])
    await until(lambda: pair.ports.journal.counts.total() >= (2 if name == "line-hold" else 30))
    pair.ports.change_attacks([])
    for end in ModemEnd:
        pair.ports.release(end)
    await pair.both_receive(10)
    pair.check()
