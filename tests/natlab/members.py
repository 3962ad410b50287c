"""A fleet with an authority, each member behind a NAT of its own: when a new member has its links, how a bulletin
spreads, and what the fleet costs while nothing happens.
"""

from __future__ import annotations

import asyncio
import hashlib
import socket
import struct
import time
from base64 import b64encode
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import datetime
from itertools import count
from pathlib import Path
from time import monotonic
from typing import Final, NamedTuple

from tests.namespaces import Namespace, udp_socket_in
from tests.natlab.daemons import PORT, RELAY
from tests.natlab.laboratory import Laboratory, Place
from tests.processes.frames import numbered
from tests.processes.harness import Stage
from tests.processes.members import CertifiedFleet
from tests.processes.process import DaemonProcess
from tests.waiting import PATIENCE_S
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.lab.evaluation.records import cpu_seconds

GROUND: Final = "ground"
GROUND_SYSTEM: Final = 255
KIND: Final = "linux"
_INTO: Final = "127.0.0.1", 14550
_EAR: Final = "127.0.0.1", 14551
"""Where a daemon receives frames of its client, and sends those of its peers."""
FRAME_S: Final = 0.02
"""Interval of the frames that the revoked member sends to few, and to many more rarely: they share processors."""
FRAMES_PER_S: Final = 500.0
"""That all others get of it at most."""
SPREAD_S: Final = 3.0
"""How long bytes are counted after a publication, and before it."""
SETTLE_S: Final = 1.0
TICK_S: Final = 0.004
"""Linux notes the time of a file no finer than this."""
_POLL_S: Final = 0.05
_SO_TIMESTAMPNS: Final = 35
_ETHERNET: Final = 14


@dataclass(frozen=True, slots=True)
class Scenario:
    vehicles: int
    is_swarm: bool = False
    """Vehicles call each other too, not only the ground station."""
    delay_s: float = 0.01
    """Of each member's line, in each direction: a quarter of the round trip between two of them."""


class Joined(NamedTuple):
    """A new member. Seconds until all links that it asks for are up."""

    vehicle: DaemonProcess
    since_start_s: float
    """From when its process was started."""
    since_ready_s: float
    """From when it had read its files and listened."""


class Spread(NamedTuple):
    """Of one bulletin. Times in seconds from its publication."""

    to_last_s: float
    """Until the last member has it on its disk."""
    sent_bytes: int
    """IP packets of all daemons within :data:`SPREAD_S`, above those of the same time before."""


class Revocation(NamedTuple):
    """Of a member that talks to all."""

    to_last_s: float
    frames_before: int
    """Of the revoked one, which all members delivered before they had the bulletin."""
    frames_after: int


class Fleet:
    """A relay on the internet, a ground station and vehicles that know only the relay."""

    def __init__(self, laboratory: Laboratory, stage: Stage, scenario: Scenario, *, is_pinned: bool = False) -> None:
        self._laboratory = laboratory
        self._stage = stage
        self._scenario = scenario
        self._is_pinned = is_pinned
        self._authority = CertifiedFleet()
        self._places: dict[str, Place] = {}
        self._loss = 0.0
        public = laboratory.public()
        self._numbers = count(1)
        self.vehicles: list[DaemonProcess] = []
        self.systems: dict[str, int] = {}
        self.relay = self._daemon(RELAY, public, public.address)
        if is_pinned:
            self.relay.command = "relay"
            del self.relay.config["endpoint"], self.relay.config["peer"]
            self.relay.config["member"] = []
        else:
            self._authority.join(self.relay, MemberRole.RELAY)
        self.ground = self._member(GROUND, MemberRole.OPERATOR, GROUND_SYSTEM)
        for _ in range(scenario.vehicles):
            self._vehicle()

    @property
    def members(self) -> list[DaemonProcess]:
        return [self.ground, *self.vehicles]

    async def start(self) -> None:
        """Start one after the other, each when those before have their links: they share few processors."""
        await self._stage.start(self.relay, self.ground, linked=False)
        for number, vehicle in enumerate(self.vehicles):
            await vehicle.start()
            others = self.vehicles[:number] if self._has_link(vehicle) else []
            await _until_up(vehicle, {one.name for one in (self.ground, *others)})
            await _until_up(self.ground, {vehicle.name})

    def lose(self, loss: float) -> None:
        """From now on each path between two members loses this share of packets: each one's line a part of it."""
        self._loss = 1 - (1 - loss) ** 0.5
        for member in self.members:
            self._places[member.name].lose(self._loss)

    # A new member.

    async def join(self) -> Joined:
        """One more vehicle. Only its own machine is touched."""
        present = (self.relay, *self.members)
        before = _hashes(present)
        vehicle = self._vehicle()
        began, began_at = monotonic(), time.time()
        await vehicle.start()
        others = self.members if self._has_link(vehicle) else [self.ground]
        await _until_up(vehicle, {one.name for one in others if one is not vehicle})
        await _until_up(self.ground, {vehicle.name})
        took_s = monotonic() - began
        assert _hashes(present) == before, "a file of another member has changed"
        (started,) = vehicle.events("daemon_started")
        return Joined(vehicle, took_s, took_s - (_seconds(started["timestamp"]) - began_at))

    # Bulletins.

    async def publish(self) -> Spread:
        """A bulletin that changes nothing but its number."""
        await asyncio.sleep(SPREAD_S)
        counts = [self._sent_bytes()]
        await asyncio.sleep(SPREAD_S)
        counts.append(self._sent_bytes())
        to_last, published = await self._publish()
        await asyncio.sleep(published + SPREAD_S - time.time())
        counts.append(self._sent_bytes())
        return Spread(max(to_last.values()), counts[2] - 2 * counts[1] + counts[0])

    async def revoke(self, revoked: DaemonProcess) -> Revocation:
        """Revoke a vehicle that has joined, while it sends frames to all; then remove it."""
        talkers = [one for one in self.members if one is not revoked and self._has_link(one)]
        with ExitStack() as stack:
            ears = [stack.enter_context(_listen(self._places[one.name].host)) for one in talkers]
            talking = asyncio.create_task(self._talk(revoked, max(FRAME_S, len(talkers) / FRAMES_PER_S)))
            try:
                await asyncio.sleep(SETTLE_S)
                to_last, published = await self._publish(revoked)
                await asyncio.sleep(SETTLE_S)
            finally:
                talking.cancel()
            before = after = 0
            for one, ear in zip(talkers, ears, strict=True):
                late = [at > published + to_last[one.name] + TICK_S for at in _arrivals(ear)]
                before, after = before + late.count(False), after + late.count(True)
        for one in self.members:
            if one is not revoked:
                status = await one.status()
                assert revoked.name not in status["peers"]
        await revoked.stop()
        self.vehicles.remove(revoked)
        return Revocation(max(to_last.values()), before, after)

    async def _publish(self, *revoked: DaemonProcess) -> tuple[dict[str, float], float]:
        """Seconds until each daemon that is not revoked has the bulletin on its disk, and the time of publication."""
        request = self._authority.revoke(*(one.name for one in revoked))
        text = b64encode(self._authority.bulletin)
        missing = {one.name: self._state(one) for one in (self.relay, *self.members) if one not in revoked}
        to_each: dict[str, float] = {}
        published = time.time()
        answer = await self.ground.ask(request)
        assert answer["verdict"] == "newer"
        give_up_at = monotonic() + PATIENCE_S
        while missing:
            assert monotonic() < give_up_at, f"{sorted(missing)} have not got it"
            for name, path in list(missing.items()):
                with suppress(FileNotFoundError):
                    if text in path.read_bytes():
                        to_each[name] = max(0.0, path.stat().st_mtime - published)
                        del missing[name]
            await asyncio.sleep(_POLL_S)
        return to_each, published

    def _state(self, daemon: DaemonProcess) -> Path:
        return daemon.config_file.with_name(f"{daemon.name}.fleet-state")

    async def _talk(self, vehicle: DaemonProcess, interval_s: float) -> None:
        """Positions, without end."""
        sock = udp_socket_in(self._places[vehicle.name].host.path)
        number, system = 0, self.systems[vehicle.name]
        with sock:
            while True:
                with suppress(OSError):
                    sock.sendto(numbered(number & 255, system), _INTO)
                number += 1
                await asyncio.sleep(interval_s)

    # Cost.

    async def idle(self, seconds: float) -> tuple[float, float]:
        """Processor time of all daemons in a second, and bytes of IP packets that they send in a second."""
        await asyncio.sleep(SETTLE_S)
        pids = [one.pid for one in (self.relay, *self.members)]
        began, cpu_s, sent = monotonic(), sum(map(cpu_seconds, pids)), self._sent_bytes()
        await asyncio.sleep(seconds)
        took_s = monotonic() - began
        return (sum(map(cpu_seconds, pids)) - cpu_s) / took_s, (self._sent_bytes() - sent) / took_s

    def _sent_bytes(self) -> int:
        total = 0
        for one in (self.relay, *self.members):
            if one.is_running:
                lines = Path(f"/proc/{one.pid}/net/dev").read_text(encoding="ascii").splitlines()
                fields = next(line.split() for line in lines if line.strip().startswith("wan:"))
                total += int(fields[9]) - _ETHERNET * int(fields[10])
        return total

    # How it is built.

    def _vehicle(self) -> DaemonProcess:
        number = next(self._numbers)
        self.systems[f"v{number}"] = number
        vehicle = self._member(f"v{number}", MemberRole.VEHICLE, number)
        if self._is_pinned:
            self.ground.add_peer(vehicle, [], role="vehicle", system_ids=[number])
            vehicle.add_peer(self.ground, [], role="operator", system_ids=[GROUND_SYSTEM])
        elif self._scenario.is_swarm:
            vehicle.config["fleet"]["call"] = ["operator", "vehicle"]
        self.vehicles.append(vehicle)
        return vehicle

    def _member(self, name: str, role: MemberRole, system_id: int) -> DaemonProcess:
        place = self._laboratory.place(KIND, delay_s=self._scenario.delay_s, loss=self._loss)
        member = self._daemon(name, place, "0.0.0.0")
        member.add_endpoint("autopilot", f"udpin:{_INTO[0]}:{_INTO[1]}")
        member.add_endpoint("screen", f"udpout:{_EAR[0]}:{_EAR[1]}")
        if self._is_pinned:
            relay = {"name": RELAY, "public_key": self.relay.public_key, "addresses": [self.relay.address]}
            member.config["relay"] = [relay]
            self.relay.config["member"].append({"name": name, "public_key": member.public_key})
        else:
            self._authority.join(member, role, system_id, self.relay)
        return member

    def _daemon(self, name: str, place: Place, address: str) -> DaemonProcess:
        daemon = self._stage.daemon(name, [f"{address}:{PORT}"])
        daemon.launcher = place.host.launcher
        self._places[name] = place
        return daemon

    def _has_link(self, one: DaemonProcess) -> bool:
        return one is self.ground or self._scenario.is_swarm


async def _until_up(daemon: DaemonProcess, names: set[str]) -> None:
    """Wait until these peers of a daemon are up. With many peers an answer costs milliseconds."""
    give_up_at, missing = monotonic() + PATIENCE_S, names
    while missing:
        assert monotonic() < give_up_at, f"{daemon.name} has no link with {sorted(missing)}"
        await asyncio.sleep(_POLL_S)
        with suppress(OSError, ValueError):  # it does not answer yet
            status = await daemon.status()
            missing = {name for name in names if status["peers"].get(name, {}).get("state") != "up"}


def _hashes(daemons: Iterable[DaemonProcess]) -> dict[Path, bytes]:
    """Of each file in the folders of these daemons, but for the state in which they note whom they met."""
    files = [path for one in daemons for path in one.folder.rglob("*") if path.is_file()]
    files = [path for path in files if path.suffix != ".fleet-state"]
    return {path: hashlib.sha256(path.read_bytes()).digest() for path in files}


def _listen(host: Namespace) -> socket.socket:
    """The client of a daemon: the kernel keeps what comes, with its time."""
    sock = udp_socket_in(host.path, *_EAR)
    sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    return sock


def _arrivals(sock: socket.socket) -> Iterator[float]:
    """When each datagram came, by the system's clock."""
    with suppress(BlockingIOError):
        while True:
            _, ((_, _, stamp), *_), _, _ = sock.recvmsg(4096, 64)
            seconds, nanoseconds = struct.unpack("qq", stamp)
            yield seconds + nanoseconds / 1e9


def _seconds(timestamp: str) -> float:
    return datetime.fromisoformat(timestamp).timestamp()
