"""The vehicles, daemons, radio and ground station of one flight, connected.

::

    with radios:      autopilot ─ tap ─ uavlinkd ─ radio ─ uavlinkd ─ station
    with relays:      autopilot ─ tap ─ uavlinkd ─ relay ─ uavlinkd ─ station
    without daemons:  autopilot ─ tap ─ station

The taps, the station and our own simulator are in this process, all others are processes of their own. The radio is
left out where nothing has to be impaired. A tap records each frame and changes nothing. It opens a new socket for
each source port of the autopilot, so what lies behind the tap sees the new port when the autopilot restarts.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

from tests.kernel_queues import cpu_s
from tests.namespaces import Namespace
from tests.processes.fleet import AN_OPERATOR, a_vehicle, make_relay
from tests.processes.frames import sender_of
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from tests.processes.tls import listen_for_tls
from tests.processes.udp import Sockaddr, open_socket, shown
from tests.sitl.ledger import SETTLED_S, Comparison, Passing, compare, compare_by, source_of, split
from tests.sitl.radio import Condition, Radio
from tests.sitl.simulators import Simulator
from tests.sitl.station import Station
from tests.waiting import until


class Tap(asyncio.DatagramProtocol):
    """The end of the link at an autopilot. The autopilot sends to :attr:`address`, the tap to ``onward``."""

    def __init__(self) -> None:
        self.from_autopilot: list[Passing] = []
        self.to_autopilot: list[Passing] = []
        self.stray_bytes = 0
        """Bytes from the autopilot that belong to no frame."""
        self.sources = 0
        """The number of source ports that the autopilot has used."""
        self.onward: Sockaddr | None = None
        self._sock = open_socket("127.0.0.1")
        self._autopilot: Sockaddr | None = None
        self._faces: dict[Sockaddr, _Face] = {}
        self._transport: asyncio.BaseTransport

    @property
    def address(self) -> Sockaddr:
        """Where the autopilot sends."""
        host, port = self._sock.getsockname()
        return host, port

    async def open(self, port: int = 0) -> None:
        """Open the socket for the autopilot."""
        if port:
            self._sock.close()
            self._sock = open_socket("127.0.0.1", port)
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, sock=self._sock)

    async def send(self, frame: bytes) -> None:
        """Send a frame of our own to the autopilot, as soon as its port is known."""
        await until(lambda: self._autopilot is not None)
        assert self._autopilot is not None
        self._sock.sendto(frame, self._autopilot)

    def close(self) -> None:
        """Close all sockets."""
        for transport in (self._transport, *(face.transport for face in self._faces.values())):
            transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """The autopilot sent a datagram."""
        now = monotonic()
        frames, stray = split(data)
        self.stray_bytes += stray
        self.from_autopilot += [Passing(now, frame) for frame in frames]
        source = self._autopilot = addr[:2]
        face = self._faces.get(source)
        if face is None:
            self.sources += 1
            face = self._faces[source] = _Face(self, source)
            face.opening = asyncio.ensure_future(face.open())
        if self.onward is not None:
            face.sock.sendto(data, self.onward)

    def deliver(self, data: bytes, autopilot: Sockaddr) -> None:
        """Send a datagram to the autopilot."""
        now = monotonic()
        if autopilot == self._autopilot:  # not a port that the autopilot no longer uses
            self.to_autopilot += [Passing(now, frame) for frame in split(data)[0]]
        self._sock.sendto(data, autopilot)


class _Face(asyncio.DatagramProtocol):
    """The tap's socket in place of one source port of the autopilot."""

    def __init__(self, tap: Tap, autopilot: Sockaddr) -> None:
        self._tap = tap
        self._autopilot = autopilot
        self.sock = open_socket("127.0.0.1")
        self.transport: asyncio.BaseTransport
        self.opening: asyncio.Future[None]

    async def open(self) -> None:
        """Receive from now on."""
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, sock=self.sock)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """The daemon, the radio or the station sent a datagram."""
        self._tap.deliver(data, self._autopilot)


GROUND, AUTOPILOT_ENDPOINT = "ground", "autopilot"
LINK_S = 120.0
"""How long a simulator may take to send its first heartbeat."""
_CUT = """table inet cut {
    chain input {
        type filter hook input priority 0
        meta l4proto tcp drop
    }
}"""
"""Dropped where they arrive: the sender sees nothing of it, as on a path without network."""


@dataclass(slots=True)
class Vehicle:
    """An autopilot, its tap, and its daemon if there is one."""

    system: int
    tap: Tap
    simulator: Simulator
    daemon: DaemonProcess | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """How vehicles and station are connected."""

    is_direct: bool = False
    """Whether there are no daemons."""
    radios: Sequence[Mapping[str, object]] = ()
    """The impairments of each radio that is there under every condition."""
    relays: int = 0
    """How many relays are between the vehicles and the station, in place of radios."""
    by_tls: bool = False
    """Whether the relays are reached by TLS alone. The flight has a network namespace of its own, to be cut."""


@dataclass(slots=True)
class World:
    """Everything that a flight consists of."""

    stage: Stage
    condition: Condition
    station: Station
    vehicles: list[Vehicle] = field(default_factory=list)
    ground: DaemonProcess | None = None
    radios: list[Radio] = field(default_factory=list)
    """The radios between vehicles and station. Each carries every link all the time."""
    network: Namespace | None = None
    """Where all of this is, if not on the loopback interface of the machine."""
    relays: list[DaemonProcess] = field(default_factory=list)
    """The only ways from the vehicles to the station, if there are any."""
    maintenance: Tap | None = None
    """The other end of the autopilot's second port."""

    @property
    def daemons(self) -> list[DaemonProcess]:
        """All daemons at the ends of links; empty in a flight without daemons."""
        return [daemon for daemon in (self.ground, *(vehicle.daemon for vehicle in self.vehicles)) if daemon]

    async def until_connected(self) -> None:
        """Wait until the station receives each vehicle, and each vehicle's tap receives the station."""
        for vehicle in self.vehicles:
            await self.station.until(
                lambda system=vehicle.system: self.station.mode(system) is not None,  # type: ignore[misc]
                LINK_S,
                f"a heartbeat of vehicle {vehicle.system}",
            )

    async def cut(self) -> None:
        """Drop every datagram of the radios, or every packet of TCP, in both directions."""
        if self.network is not None:
            self.network.nft(_CUT)
        for radio in self.radios:
            await radio.cut()

    async def restore(self) -> None:
        """End :meth:`cut`."""
        if self.network is not None:
            self.network.nft("delete table inet cut")
        for radio in self.radios:
            await radio.restore()

    async def maintain(self, frame: bytes) -> None:
        """Send a frame to the autopilot on its second port."""
        assert self.maintenance is not None
        await self.maintenance.send(frame)

    async def measure(self) -> Measurement:
        """Begin to count frames and CPU time."""
        measurement = Measurement(self)
        await measurement.begin()
        return measurement


class Measurement:
    """Counts frames at both ends, and the CPU time of the daemons, from :meth:`begin` to :meth:`end`."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._statuses: dict[str, Status] = {}
        self._cpu_s: dict[str, float] = {}

    async def begin(self) -> None:
        """Count from now on."""
        self._statuses = {daemon.name: await daemon.status() for daemon in self._world.daemons}
        self._cpu_s = {daemon.name: cpu_s(daemon.pid) for daemon in self._world.daemons}
        self._stray_bytes = sum(vehicle.tap.stray_bytes for vehicle in self._world.vehicles)
        self._begin = monotonic()

    async def end(self) -> dict[str, object]:
        """Count until now, and wait until each frame has arrived or is lost; the figures."""
        world, end = self._world, monotonic()
        seconds = end - self._begin
        used = {daemon.name: cpu_s(daemon.pid) - self._cpu_s[daemon.name] for daemon in world.daemons}
        await asyncio.sleep(2 * SETTLED_S)
        withheld: Counter[tuple[str, str]] = Counter()
        for daemon in world.daemons:
            withheld += refused_between(self._statuses[daemon.name], await daemon.status())
        by_message: Counter[str] = Counter()
        for (message, _), count in withheld.items():
            by_message[message] += count
        down, up = await asyncio.to_thread(self._compare, end)  # the station goes on with its heartbeats
        down, up = down.without(by_message), up.without(by_message)
        return {
            "seconds": round(seconds, 2),
            "down": down.figures(),
            "up": up.figures(),
            "frames_s": round((down.sent + up.sent) / seconds, 1),
            "withheld": {f"{message}: {reason}": count for (message, reason), count in withheld.items()},
            "cpu_percent": {name: round(100 * s / seconds, 2) for name, s in used.items()},
            "exact": down.is_exact and up.is_exact,
            "stray_bytes": sum(vehicle.tap.stray_bytes for vehicle in world.vehicles) - self._stray_bytes,
        }

    def _compare(self, end: float) -> tuple[Comparison, Comparison]:
        world = self._world
        down, up = Comparison(), Comparison()
        for vehicle in world.vehicles:
            system, station = vehicle.system, world.station
            received = [passing for passing in station.received if sender_of(passing.frame) == system]
            down.add(compare_by(source_of, vehicle.tap.from_autopilot, received, self._begin, end))
            sent = [passing for passing in station.sent if passing.target in (0, system)]
            arrived = [passing for passing in vehicle.tap.to_autopilot if sender_of(passing.frame) == station.system]
            up.add(compare(sent, arrived, self._begin, end))
        return down, up


def refused_between(before: Status, after: Status) -> Counter[tuple[str, str]]:
    """The frames that a daemon withheld from the ground station's link since, by message and reason."""
    counts: Counter[tuple[str, str]] = Counter()
    for status, sign in ((before, -1), (after, 1)):
        for name, part in (*status["peers"].items(), *status["endpoints"].items()):
            if status["name"] != GROUND and name not in (GROUND, AUTOPILOT_ENDPOINT):
                continue  # what another vehicle may not receive does not concern the ground station
            for messages in part["refused"].values():
                for message, reasons in messages.items():
                    for reason, count in reasons.items():
                        counts[message, reason] += sign * count
    return +counts


@asynccontextmanager
async def flying(
    simulators: Sequence[Simulator],
    layout: Layout,
    condition: Condition,
    *,
    maintenance_port: int | None,
) -> AsyncIterator[World]:
    """Start everything, and wait until the station receives each vehicle.

    ``simulators``: one for each vehicle, not yet started. ``maintenance_port``: where a simulator sends MAVLink on a
    second port.
    """
    async with AsyncExitStack() as stack:
        network = stack.enter_context(Namespace()) if layout.by_tls else None
        if network is not None:
            stack.enter_context(network.entered())
        stage = await stack.enter_async_context(Stage())
        world = World(stage, condition, await stack.enter_async_context(Station()), network=network)
        for number, impairments in enumerate(layout.radios or [{}] * bool(condition.radio)):
            radio = Radio(stage.folder, {**impairments, **condition.radio}, number, f"radio{number}")
            stack.push_async_callback(radio.stop)
            world.radios.append(radio)
        if maintenance_port is not None:
            world.maintenance = Tap()
            await world.maintenance.open(maintenance_port)
            stack.callback(world.maintenance.close)
        for simulator in simulators:
            tap = Tap()
            await tap.open()
            stack.callback(tap.close)
            world.vehicles.append(Vehicle(simulator.system, tap, simulator))
        if layout.is_direct:
            (vehicle,) = world.vehicles
            vehicle.tap.onward = world.station.address
        else:
            await _start_daemons(world, layout)
        for vehicle in world.vehicles:
            stack.push_async_callback(vehicle.simulator.stop)
            await vehicle.simulator.start(vehicle.tap.address)
        await world.until_connected()
        yield world


async def _start_daemons(world: World, layout: Layout) -> None:
    stage = world.stage
    ground = world.ground = stage.daemon(GROUND)
    ground.add_endpoint("station", f"udpout:{shown(world.station.address)}")
    for vehicle in world.vehicles:
        drone = vehicle.daemon = stage.daemon(f"drone{vehicle.system}")
        vehicle.tap.onward = drone.add_endpoint(AUTOPILOT_ENDPOINT)
        ways = [radio.connect(drone.name, drone.sockaddr, ground.sockaddr) for radio in world.radios]
        to_ground, to_drone = zip(*(ways or [(ground.sockaddr, drone.sockaddr)]), strict=True)
        psk = stage.psk()
        drone.add_peer(ground, [] if layout.relays else list(map(shown, to_ground)), psk, **AN_OPERATOR)
        ground.add_peer(drone, [] if layout.relays else list(map(shown, to_drone)), psk, **a_vehicle(vehicle.system))
    for number in range(1, layout.relays + 1):
        relay = stage.daemon(f"relay{number}")
        make_relay(relay, *world.daemons)
        if layout.by_tls:
            url = listen_for_tls(relay)
            for daemon in world.daemons:
                daemon.config["relay"][-1]["addresses"] = [url]
        world.relays.append(relay)
    for daemon in world.daemons:
        daemon.config["link"].update(world.condition.link, **({"confidential": True} if layout.relays else {}))
    for radio in world.radios:
        await radio.start()
    await stage.start(*world.relays, linked=False)
    await stage.start(*world.daemons)
