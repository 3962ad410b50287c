"""Two emulated radios between a vehicle and its ground station, and what carries the frames over them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

from uavlinkd.config.keys import generate_psk
from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.middle import HOST, silent_log
from uavlinkd.lab.evaluation.paths_plan import (
    BOTH,
    STATION,
    VEHICLE,
    RadioChange,
)
from uavlinkd.lab.mitm.anatomy import envelope_of
from uavlinkd.lab.mitm.attack import Action, Direction, PassiveAttack, Send
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.links import MavlinkConnection, open_connection
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.system.addresses import Address

OnFrame = Callable[[bytes], None]
RECORDS: Final = "records"
"""Datagrams without frames: probes, echoes, handshakes."""
_FREE: Final = Address(HOST, 0)
_PSK_FILE: Final = "pair.psk"
_METERED: Final = "metered"
_NETWORKS: Final = {"unmetered": HOST, _METERED: "127.0.0.2"}
"""Where the sockets of the vehicle's networks are bound, by name."""


class PathWatch(PassiveAttack):
    """Passes everything. Counts what enters a radio, and notes when it carried frames of which class."""

    name = "watch"

    def __init__(self) -> None:
        self._split = SplitCounters()
        self.begin(0.0)

    def begin(self, now: float) -> None:
        """Count from now on."""
        self.began_at = now
        self.datagrams = 0
        self.bytes = 0
        """UDP payloads, both directions together."""
        self.bytes_of: Counter[str] = Counter()
        """The same by class of the frames, or :data:`RECORDS`."""
        self.carried: defaultdict[tuple[str, Class], list[float]] = defaultdict(list)
        """By sender and class: when a datagram with such frames was sent, in seconds."""

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Count a datagram."""
        self.datagrams += 1
        self.bytes += len(datagram)
        envelope = envelope_of(datagram)
        # Control records may precede the frames of an envelope, and its tag follows them: the search skips both.
        frames = split_datagram(datagram[envelope.header_bytes if envelope else 0 :], self._split)
        classes = {frame.header.kind.cls for frame in frames}
        self.bytes_of["+".join(sorted(classes)) or RECORDS] += len(datagram)
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
        self._proxy = Proxy(settings, [self.watch])
        self._proxy.log = silent_log()
        await self._proxy.start()

    @property
    def address(self) -> str:
        """Where the vehicle reaches the station along this path."""
        assert self._proxy is not None
        return str(Address(*self._proxy.listeners[Direction(VEHICLE, STATION)]))

    def change(self, change: RadioChange) -> None:
        """Change the radio."""
        assert self._proxy is not None
        self._proxy.change_radio(change.directions, replace(self.settings, **change.values))  # type: ignore[arg-type]

    async def stop(self) -> None:
        """Stop."""
        if self._proxy is not None:
            await self._proxy.stop()


class PathLink(ABC):
    """Carries frames between the clients of the vehicle and of the station.

    Args:
        radios: the emulated radios, by number.
        on_frame: called with each frame that a client receives.
    """

    def __init__(self, radios: Mapping[int, PathRadio], on_frame: OnFrame) -> None:
        self.radios = radios
        self._on_frame = on_frame
        self._clients: dict[str, list[MavlinkConnection]] = {VEHICLE: [], STATION: []}
        self._stack = AsyncExitStack()
        self.daemons: dict[str, DroneProcess] = {}
        """By end; plain MAVLink has none."""

    @abstractmethod
    async def open(self) -> None:
        """Start."""

    async def check(self) -> None:
        """Check that the daemons run.

        Raises:
            DroneError: a daemon has ended.
        """
        for daemon in self.daemons.values():
            await daemon.ask()

    async def close(self) -> None:
        """Stop."""
        await self._stack.aclose()

    def send(self, sender: str, frame: bytes) -> None:
        """The client of one end sends a frame."""
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


class DuplicatedLink(PathLink):
    """Plain MAVLink along every path, without daemons; each copy is delivered."""

    async def open(self) -> None:
        """Open the clients. The station sends to each path from which it received a frame."""
        station = await self._connect(STATION, f"udpin:{HOST}:0")
        for address in await self._start_radios(station.url.port):
            await self._connect(VEHICLE, f"udpout:{address}")


class DaemonsLink(PathLink):
    """Two daemons. The vehicle's one has an address of the station for each path.

    Args:
        folder: for the daemons' files; created here.
        settings: further settings of both peers.
        is_metered: the vehicle has two networks, and the second one is metered. Else it has one socket.
        is_station_on: the station's daemon runs.
    """

    def __init__(
        self,
        radios: Mapping[int, PathRadio],
        on_frame: OnFrame,
        folder: Path,
        settings: Mapping[str, object],
        *,
        is_metered: bool,
        is_station_on: bool = True,
    ) -> None:
        super().__init__(radios, on_frame)
        folder.mkdir()
        ports = free_ports(4)
        self._vehicle = DroneProcess(VEHICLE, folder / VEHICLE, ports[0], ports[1])
        self._station = DroneProcess(STATION, folder / STATION, ports[2], ports[3])
        self.daemons = {VEHICLE: self._vehicle, STATION: self._station}
        self._settings = settings
        self._is_metered = is_metered
        self._running = [VEHICLE, STATION] if is_station_on else [VEHICLE]

    @property
    def endpoints(self) -> dict[str, str]:
        """Where a client reaches each daemon."""
        return {name: f"udpout:{HOST}:{daemon.endpoint_port}" for name, daemon in self.daemons.items()}

    async def open(self) -> None:
        """Start the daemons, which then link."""
        self.configure(await self._start_radios(self._station.port))
        for name in self._running:
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
            addresses = [
                {"address": address, "network": name} for address, name in zip(addresses, _NETWORKS, strict=False)
            ]
        psk = generate_psk()
        for daemon in self.daemons.values():
            daemon.share_psk(psk, _PSK_FILE)
        peer = self._station.as_peer("", _PSK_FILE, **{"addresses": addresses, **self._settings})
        self._vehicle.configure({}, [peer], networks)
        peer = self._vehicle.as_peer("", _PSK_FILE, **{"addresses": [], **self._settings})
        self._station.configure({}, [peer])
