"""The frames of the paths evaluation, and what carries them: two emulated radios between a vehicle and its station.

The frames are a normal mix. Each is numbered at its sender and matched at its receiver.
"""

from __future__ import annotations

import asyncio
import heapq
import struct
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Final

from uavlinkd.config.keys import generate_psk
from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.middle import HOST, silent_log
from uavlinkd.lab.evaluation.paths_plan import BOTH, STATION, VEHICLE, PathsPlan, RadioChange, Scenario
from uavlinkd.lab.evaluation.records import Record, Value
from uavlinkd.lab.mitm.anatomy import envelope_of, mavlink_frame
from uavlinkd.lab.mitm.attack import Action, Direction, PassiveAttack, Send
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.links import MavlinkConnection, open_connection
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.mavlink.dialect import COMMANDS, IDS, KINDS, MESSAGES
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.system.addresses import Address

SYSTEM_IDS: Final = {VEHICLE: 1, STATION: 255}
_NUMBER = struct.Struct("<I")
_FILL: Final = bytes(range(1, 256))
"""Bytes of a payload that are not zero: MAVLink 2 would omit zeros at the end."""
_GOLDEN_RATIO: Final = 0.618
"""Its multiples, without their integer part, are far from each other: flows of equal rates do not send together."""
_SKIP_AFTER_S: Final = 0.25
"""After a pause of this process, frames that are due for longer are not sent."""


@dataclass(frozen=True)
class NumberedFlow:
    """One message that one end sends at a rate."""

    sender: str
    message: str
    rate_hz: float
    number_at: int = 0
    """Offset of the number in the payload: 4 bytes whose value does not matter here."""
    fixed: tuple[tuple[int, bytes], ...] = ()
    """Values of other fields, by offset."""

    @cached_property
    def message_id(self) -> int:
        return IDS[self.message]

    @property
    def cls(self) -> Class:
        return KINDS[self.message_id].cls

    @property
    def is_state(self) -> bool:
        """Whether a newer frame replaces an older one."""
        return KINDS[self.message_id].is_state

    def frame(self, number: int) -> bytes:
        _, crc_extra, shortest, longest, *_ = MESSAGES[self.message_id]
        has_room = self.number_at + _NUMBER.size <= shortest
        payload = bytearray(_FILL[: shortest if has_room else longest])
        for at, value in (*self.fixed, (self.number_at, _NUMBER.pack(number)), *self._target()):
            payload[at : at + len(value)] = value
        return mavlink_frame(self.message_id, bytes(payload), crc_extra, SYSTEM_IDS[self.sender], number)

    def _target(self) -> list[tuple[int, bytes]]:
        (receiver,) = set(SYSTEM_IDS) - {self.sender}
        *_, system_at, component_at, _ = MESSAGES[self.message_id]
        ids = ((system_at, SYSTEM_IDS[receiver]), (component_at, 1))
        return [(at, bytes((value,))) for at, value in ids if at is not None]


_COPTER, _GROUND_STATION = bytes((2, 3, 81, 4, 3)), bytes((6, 8, 0, 4, 3))
"""Type, autopilot, base mode, status and version of a HEARTBEAT."""
_COMMAND: Final = struct.pack("<H", COMMANDS["MAV_CMD_REQUEST_MESSAGE"])
_TELEMETRY: Final = {
    "ATTITUDE": 20.0,
    "GLOBAL_POSITION_INT": 10.0,
    "LOCAL_POSITION_NED": 10.0,
    "VFR_HUD": 5.0,
    "RC_CHANNELS": 5.0,
    "GPS_RAW_INT": 2.0,
    "SYS_STATUS": 2.0,
    "SYSTEM_TIME": 1.0,
}
"""55 frames a second, as ground stations request them over Wi-Fi or LTE."""
MANUAL_RATE_HZ: Final = 25.0


def flows_of(scenario: Scenario) -> tuple[NumberedFlow, ...]:
    """The mix of a scenario: telemetry, heartbeats, texts, commands and their answers; manual control in one."""
    flows = [NumberedFlow(VEHICLE, message, rate_hz) for message, rate_hz in _TELEMETRY.items()]
    flows += [
        NumberedFlow(VEHICLE, "HEARTBEAT", 1.0, fixed=((4, _COPTER),)),
        NumberedFlow(VEHICLE, "STATUSTEXT", 0.5, number_at=1),
        NumberedFlow(VEHICLE, "COMMAND_ACK", 1.0, number_at=4, fixed=((0, _COMMAND),)),
        NumberedFlow(STATION, "HEARTBEAT", 1.0, fixed=((4, _GROUND_STATION),)),
        NumberedFlow(STATION, "COMMAND_LONG", 1.0, fixed=((28, _COMMAND),)),
    ]
    if scenario is Scenario.MANUAL:
        flows.append(NumberedFlow(STATION, "MANUAL_CONTROL", MANUAL_RATE_HZ))
    return tuple(flows)


@dataclass(slots=True)
class FlowLog:
    """When the frames of a flow were sent, by number, and each delivery with its number. Times in seconds."""

    flow: NumberedFlow
    sent_s: list[float] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    arrived_s: list[float] = field(default_factory=list)


class TrafficLog:
    """The frames of one trial. It begins with :meth:`begin`; earlier frames only show that the link works."""

    def __init__(self, flows: Sequence[NumberedFlow]) -> None:
        self.flows = tuple(flows)
        self.logs = [FlowLog(flow) for flow in flows]
        self.arrived_from: set[str] = set()
        self.began_at = 0.0
        self.late_s = 0.0
        """By how much this process sent a frame too late, at most."""
        self._next = [0] * len(self.flows)
        self._sent: dict[bytes, tuple[int, int]] = {}

    def begin(self) -> None:
        self.began_at = monotonic()
        self.late_s = 0.0
        self.logs = [FlowLog(flow) for flow in self.flows]
        self._sent.clear()

    def next_frame(self, position: int) -> bytes:
        number = self._next[position]
        self._next[position] += 1
        frame = self.flows[position].frame(number)
        times = self.logs[position].sent_s
        self._sent[frame] = position, len(times)
        times.append(monotonic() - self.began_at)
        return frame

    def on_received(self, frame: bytes) -> None:
        """A client received a frame. Frames that the other end did not send, as a daemon's own, do not count."""
        place = self._sent.get(frame)
        if place is None:
            return
        log = self.logs[place[0]]
        self.arrived_from.add(log.flow.sender)
        log.numbers.append(place[1])
        log.arrived_s.append(monotonic() - self.began_at)

    async def talk(self, send: Callable[[str, bytes], None]) -> None:
        """Send the frames of all flows when they are due, until cancelled."""
        begin = monotonic()
        phases = [number * _GOLDEN_RATIO % 1.0 for number in range(len(self.flows))]
        due = [(begin + phases[number] / flow.rate_hz, number) for number, flow in enumerate(self.flows)]
        heapq.heapify(due)
        while True:
            at, position = due[0]
            late_s = monotonic() - at
            if late_s < 0:
                await asyncio.sleep(-late_s)
                continue
            self.late_s = max(self.late_s, late_s)
            flow = self.flows[position]
            if late_s <= _SKIP_AFTER_S:
                send(flow.sender, self.next_frame(position))
            heapq.heapreplace(due, (at + 1 / flow.rate_hz, position))

    def records(self, point: dict[str, Value]) -> list[Record]:
        return [
            Record(
                "frames",
                {**point, "sender": log.flow.sender, "message": log.flow.message},
                {
                    "class": log.flow.cls.value,
                    "is_state": log.flow.is_state,
                    "sent_s": _rounded(log.sent_s),
                    "numbers": log.numbers,
                    "arrived_s": _rounded(log.arrived_s),
                },
            )
            for log in self.logs
        ]


def _rounded(times: Sequence[float]) -> list[float]:
    return [round(time_s, 4) for time_s in times]


OnFrame = Callable[[bytes], None]
_FREE: Final = Address(HOST, 0)
_PSK_FILE: Final = "pair.psk"
_METERED: Final = "metered"
_NETWORKS: Final = {"unmetered": HOST, _METERED: "127.0.0.2"}
"""Where the sockets of the vehicle's networks are bound, by name."""


class PathWatch(PassiveAttack):
    """Passes everything. Counts what enters a radio, and notes when it carried frames of which class."""

    name = "watch"

    def __init__(self) -> None:
        self.begin(0.0)

    def begin(self, now: float) -> None:
        self.began_at = now
        self.datagrams = 0
        self.bytes = 0
        """UDP payloads, both directions together."""
        self.carried: defaultdict[tuple[str, Class], list[float]] = defaultdict(list)
        """By sender and class: when a datagram with such frames was sent, in seconds."""

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        self.datagrams += 1
        self.bytes += len(datagram)
        envelope = envelope_of(datagram)
        # Control records may precede the frames of an envelope, and its tag follows them: the search skips both.
        frames = split_datagram(datagram[envelope.header_bytes if envelope else 0 :], SplitCounters())
        classes = {frame.header.kind.cls for frame in frames}
        for cls in classes:
            self.carried[direction.sender, cls].append(now - self.began_at)
        return [Send(datagram, direction)]


class PathRadio:
    """One emulated radio between the vehicle and the station, in both directions."""

    def __init__(self, settings: RadioSettings, seed: int) -> None:
        self.settings = settings
        self.watch = PathWatch()
        self._seed = seed
        self._proxy: Proxy | None = None

    async def start(self, station_port: int) -> None:
        """Start. The vehicle is known by its first datagram."""
        peers = (MitmPeer(VEHICLE), MitmPeer(STATION, Address(HOST, station_port)))
        link = MitmLink((VEHICLE, STATION), (_FREE, _FREE))
        settings = ProxySettings(peers, (link,), radios=((BOTH, self.settings),), seed=self._seed)
        self._proxy = Proxy(settings)
        self._proxy.log = silent_log()
        await self._proxy.start()
        self._proxy.change_attacks([self.watch])

    @property
    def address(self) -> str:
        """Where the vehicle reaches the station along this path."""
        assert self._proxy is not None
        return str(Address(*self._proxy.listeners[Direction(VEHICLE, STATION)]))

    def change(self, change: RadioChange) -> None:
        assert self._proxy is not None
        self._proxy.change_radio(change.directions, replace(self.settings, **change.values))  # type: ignore[arg-type]

    async def stop(self) -> None:
        if self._proxy is not None:
            await self._proxy.stop()


class PathLink:
    """Carries frames between the clients of the vehicle and of the station: plain MAVLink along every path.

    Each copy is delivered. :class:`DaemonsLink` carries them by daemons.

    Args:
        radios: the emulated radios, by number.
        on_frame: called with each frame that a client receives.
    """

    def __init__(self, radios: Mapping[int, PathRadio], on_frame: OnFrame) -> None:
        self.radios = radios
        self.daemons: dict[str, DroneProcess] = {}
        """By end; plain MAVLink has none."""
        self._on_frame = on_frame
        self._clients: dict[str, list[MavlinkConnection]] = {VEHICLE: [], STATION: []}
        self._stack = AsyncExitStack()

    async def open(self) -> None:
        """Start. The station sends to each path from which it received a frame."""
        station = await self._connect(STATION, f"udpin:{HOST}:0")
        for address in await self._start_radios(station.url.port):
            await self._connect(VEHICLE, f"udpout:{address}")

    async def check(self) -> None:
        """Check that the daemons run. Raises DroneError if a daemon has ended."""
        for daemon in self.daemons.values():
            await daemon.ask()

    async def close(self) -> None:
        await self._stack.aclose()

    def send(self, sender: str, frame: bytes) -> None:
        for client in self._clients[sender]:
            client.send(frame)

    async def _connect(self, end: str, url: str) -> MavlinkConnection:
        client = await open_connection(url, self._on_frame)
        self._stack.push_async_callback(client.close)
        self._clients[end].append(client)
        return client

    async def _start_radios(self, station_port: int) -> list[str]:
        for radio in self.radios.values():
            self._stack.push_async_callback(radio.stop)
            await radio.start(station_port)
        return [radio.address for radio in self.radios.values()]


class DaemonsLink(PathLink):
    """Two daemons. The vehicle's one has an address of the station for each path.

    Args:
        folder: for the daemons' files; created here.
        plan: if it is metered, the vehicle has two networks, and the second one is metered. Else it has one socket.
    """

    settings: Mapping[str, object] = {}

    def __init__(self, radios: Mapping[int, PathRadio], on_frame: OnFrame, folder: Path, plan: PathsPlan) -> None:
        super().__init__(radios, on_frame)
        folder.mkdir()
        ports = free_ports(4)
        for number, name in enumerate((VEHICLE, STATION)):
            self.daemons[name] = DroneProcess(name, folder / name, *ports[2 * number :][:2])
        self._is_metered = plan.is_metered

    @property
    def endpoints(self) -> dict[str, str]:
        return {name: f"udpout:{HOST}:{daemon.endpoint_port}" for name, daemon in self.daemons.items()}

    async def open(self) -> None:
        self.configure(await self._start_radios(self.daemons[STATION].port))
        for name in self.daemons:
            self._stack.push_async_callback(self.daemons[name].stop)
            await self.daemons[name].start()
            await self._connect(name, self.endpoints[name])

    def configure(self, at: Sequence[str]) -> None:
        """Write the configurations. ``at``: the station's addresses for the vehicle, one for each path."""
        addresses: list[object] = [*at]
        networks: list[dict[str, object]] = []
        if self._is_metered:
            networks = [
                {"name": name, "address": host, "metered": name == _METERED} for name, host in _NETWORKS.items()
            ]
            addresses = [{"address": item, "network": name} for item, name in zip(at, _NETWORKS, strict=False)]
        psk = generate_psk()
        vehicle, station = self.daemons[VEHICLE], self.daemons[STATION]
        for daemon in (vehicle, station):
            daemon.share_psk(psk, _PSK_FILE)
        vehicle.configure({}, [station.as_peer("", _PSK_FILE, addresses=addresses, **self.settings)], networks)
        station.configure({}, [vehicle.as_peer("", _PSK_FILE, addresses=[], **self.settings)])
