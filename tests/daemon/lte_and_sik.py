"""A vehicle and a ground station with LTE (UDP through a relay) and emulated SiK modems, and traffic as in flight."""

from __future__ import annotations

import asyncio
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from tests.daemon.frames import pack
from tests.daemon.harness import Stage
from tests.daemon.losses import lost_to_waiting
from tests.daemon.process import DaemonProcess, Status
from tests.daemon.relay import End, Relay
from tests.daemon.udp import Client, Sockaddr
from tests.waiting import until
from uavlinkd.lab.mitm.modem import Fate, ModemEnd, ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload

EXAMPLE = Path(__file__).parents[2] / "configs" / "lte-and-sik.toml"
TICK_S = 0.05
"""The vehicle sends a state each time: 20 a second."""
CRITICAL_EVERY = 8
"""Each end sends a heartbeat each so many ticks, and the ground station a command."""
VEHICLE, STATION = 5, 255
"""System IDs, as in the example."""
HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT


class Crew:
    """The client of one end: what it sent, in order, and what it received from the other one."""

    def __init__(self, client: Client, into: Sockaddr, system: int, other: int) -> None:
        self.critical: list[bytes] = []
        self.states: list[bytes] = []
        self.received: Counter[bytes] = Counter()
        self.on_frame: Callable[[Frame], None] = lambda frame: None
        self._client = client
        self._into = into
        self._system = system
        self._other = other

    def say(self, message: Any, *, is_critical: bool = True) -> None:
        """Send a message."""
        frame = pack(message, self._system)
        (self.critical if is_critical else self.states).append(frame)
        self._client.send(frame, self._into)

    def read(self) -> None:
        """Read what has come."""
        data = bytes(self._client.received)
        self._client.clear()
        counters = SplitCounters()
        frames = split_payload(data, counters)
        assert b"".join(frame.raw for frame in frames) == data, "bytes that do not form whole frames"
        for frame in frames:
            if frame.raw[5] == self._other:  # others are notes of the daemon
                self.received[frame.raw] += 1
                self.on_frame(frame)


@dataclass
class Outcome:
    """What became of critical frames in both directions."""

    arrived: int = 0
    lost: list[str] = field(default_factory=list)
    """Commands, answers and heartbeats that did not arrive."""
    superseded: int = 0
    """Heartbeats instead of which the next one arrived: a daemon drops a state if a newer one overtakes it."""
    to_waiting: int = 0
    """Frames that they lost since then because a process had to wait for a processor."""


class LteAndSik:
    """Both daemons with the networks, roles and system IDs of the example. Call :meth:`start` and :meth:`stop`."""

    def __init__(self, stage: Stage, modem: ModemSettings) -> None:
        self.vehicle, self.ground = stage.daemon("drone4"), stage.daemon("ground-station")
        self.ports = ModemPorts(PortSettings(stage.folder / "left", stage.folder / "right", modem, seed=1))
        self.autopilot: Crew
        self.pilot: Crew
        self._stage = stage
        self._relay: Relay
        self._task: asyncio.Task[None] | None = None

    @property
    def both(self) -> tuple[tuple[DaemonProcess, str], tuple[DaemonProcess, str]]:
        """Each daemon, with the name of its peer."""
        return (self.vehicle, self.ground.name), (self.ground, self.vehicle.name)

    async def start(self) -> None:
        """Start modems, relay, daemons and clients, and wait until both paths are usable."""
        stage = self._stage
        await self.ports.start()
        self._relay = await stage.relay()
        self._relay.attach(End.B, self.ground.sockaddr)
        host, port = self._relay.address_for(End.A)
        self._configure(f"{host}:{port}")
        clients = await stage.client(), await stage.client()
        intos = [daemon.add_endpoint("client") for daemon in (self.vehicle, self.ground)]
        self.autopilot = Crew(clients[0], intos[0], VEHICLE, STATION)
        self.pilot = Crew(clients[1], intos[1], STATION, VEHICLE)
        self.autopilot.on_frame = self._acknowledge
        await stage.start(self.vehicle, self.ground)
        self._task = asyncio.create_task(self._fly())
        await self.until_usable(2)

    async def stop(self) -> None:
        """Stop the clients and the modems."""
        if self._task is not None:
            self._task.cancel()
        await self.ports.stop()

    def _configure(self, lte: str) -> None:
        """As in the example: only the vehicle has an address of the other end, and both have the radio."""
        example = tomllib.loads(EXAMPLE.read_text())
        (network,), (peer,) = example["network"], example["peer"]
        (_, on_radio), role = peer["addresses"], {"role": peer["role"], "system_ids": peer["system_ids"]}
        psk = self._stage.psk()
        self.vehicle.add_peer(self.ground, [], psk, **role)
        self.ground.add_peer(self.vehicle, [], psk, role="vehicle", system_ids=[VEHICLE])
        self.vehicle.config["peer"][0]["addresses"] = [lte, on_radio]
        self.ground.config["peer"][0]["addresses"] = [on_radio]
        baud = network["serial"].rpartition(":")[2]
        for daemon, end in ((self.vehicle, ModemEnd.LEFT), (self.ground, ModemEnd.RIGHT)):
            device = self.ports.settings.device(end)
            daemon.config["network"] = [{**network, "serial": f"{device}:{baud}"}]

    # Traffic.

    async def _fly(self) -> None:
        number = 0
        while True:
            number += 1
            attitude = mavlink.MAVLink_attitude_message(number, 0.1, -0.05, 1.5, 0.01, 0.02, -0.01)
            place = mavlink.MAVLink_global_position_int_message(number, 473977420, 85455940, 488000, 3000, 1, 2, 3, 4)
            self.autopilot.say(place if number % 4 == 0 else attitude, is_critical=False)
            if number % CRITICAL_EVERY == 0:
                self.autopilot.say(mavlink.MAVLink_heartbeat_message(2, 3, 81, number, 4, 3))
                self.pilot.say(mavlink.MAVLink_heartbeat_message(6, 8, 0, number, 4, 3))
            elif number % CRITICAL_EVERY == CRITICAL_EVERY // 2:
                self.pilot.say(mavlink.MAVLink_command_long_message(VEHICLE, 1, 511, 0, number, 1000, 0, 0, 0, 0, 0))
            self.read()
            await asyncio.sleep(TICK_S)

    def _acknowledge(self, frame: Frame) -> None:
        """As an autopilot does: each command has one answer, which names it."""
        if _message(frame.raw) == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
            number = len(self.autopilot.critical)
            self.autopilot.say(mavlink.MAVLink_command_ack_message(511, 0, 0, number, STATION, 190))

    def read(self) -> None:
        """Read what has come at both clients."""
        self.autopilot.read()
        self.pilot.read()

    # What happens to the networks.

    def pull_lte(self) -> None:
        """Lose everything there."""
        self._relay.on_datagram = lambda end, datagram: None

    def restore_lte(self) -> None:
        """It works again."""
        self._relay.on_datagram = self._relay.deliver

    async def pull_modem(self, end: ModemEnd) -> None:
        """Pull a plug, and wait until its daemon has noticed and the other modem has sent in vain."""
        daemon = self.vehicle if end is ModemEnd.LEFT else self.ground
        self.ports.pull(end)
        await daemon.until(lambda status: not status["networks"]["sik"]["is_present"])
        written = self.ports.link.bytes[end.other]
        before = written[Fate.WRITTEN]
        await until(lambda: written[Fate.WRITTEN] > before + 500)

    async def until_usable(self, count: int) -> None:
        """Wait until both ends have so many usable paths."""
        for daemon, peer in self.both:
            await daemon.until(lambda status, peer=peer: _usable(status, peer) == count)  # type: ignore[misc]

    async def until_best(self, network: str | None) -> None:
        """Wait until both ends send along this network. None: along LTE, which is not a `[[network]]`."""
        for daemon, peer in self.both:
            await daemon.until(lambda status, peer=peer: _best(status, peer)["network"] == network)  # type: ignore[misc]

    # What arrived.

    def mark(self) -> tuple[int, int]:
        """How many critical frames each end has sent."""
        return len(self.autopilot.critical), len(self.pilot.critical)

    async def cross(self, count: int) -> None:
        """Wait until each end has received so many of the critical frames that the other one sends from now on."""
        marks = self.mark()
        await until(
            lambda: all(
                sum(frame in hearer.received for frame in speaker.critical[mark:]) >= count
                for (speaker, hearer), mark in zip(self._ways, marks, strict=True)
            )
        )

    async def outcome(self, since: tuple[int, int]) -> Outcome:
        """The critical frames sent since then, up to now. Waits until later ones have arrived at both ends."""
        before = self.mark()
        await self.cross(3)
        outcome = Outcome()
        for (speaker, hearer), first, end in zip(self._ways, since, before, strict=True):
            for at, frame in enumerate(speaker.critical[first:end], first):
                if frame in hearer.received:
                    outcome.arrived += 1
                elif _message(frame) == HEARTBEAT and _next_heartbeat(speaker.critical, at) in hearer.received:
                    outcome.superseded += 1
                else:
                    outcome.lost.append(frame.hex(" "))
        outcome.to_waiting = await self._lost_to_waiting()
        return outcome

    async def _lost_to_waiting(self) -> int:
        """Frames that daemons lost because a process had to wait for a processor."""
        return await lost_to_waiting(self.vehicle, self.ground) + await lost_to_waiting(self.ground, self.vehicle)

    async def line_noise(self) -> int:
        """Damaged pieces that both daemons received from the line."""
        statuses = [await daemon.status() for daemon, _ in self.both]
        return sum(int(status["networks"]["sik"]["serial"]["line_noise"]) for status in statuses)

    def check(self) -> None:
        """Each client received only what the other one sent, unaltered, and each frame once."""
        for speaker, hearer in self._ways:
            assert hearer.received.keys() <= {*speaker.critical, *speaker.states}, "a frame that no client sent"
            assert set(hearer.received.values()) == {1}, "a frame was delivered twice"

    @property
    def _ways(self) -> tuple[tuple[Crew, Crew], tuple[Crew, Crew]]:
        return (self.autopilot, self.pilot), (self.pilot, self.autopilot)


def _message(frame: bytes) -> int:
    return int.from_bytes(frame[7:10], "little")


def _next_heartbeat(frames: list[bytes], at: int) -> bytes | None:
    return next((frame for frame in frames[at + 1 :] if _message(frame) == HEARTBEAT), None)


def _usable(status: Status, peer: str) -> int:
    return [path["state"] for path in status["peers"][peer]["paths"]].count("usable")


def _best(status: Status, peer: str) -> dict[str, Any]:
    paths: list[dict[str, Any]] = status["peers"][peer]["paths"]
    return next(path for path in paths if path["address"] == status["peers"][peer]["path"])
