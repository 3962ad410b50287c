"""Exceptions planted in a running daemon with three peers: what each costs, and whom.

``python -m tests.faults.planted`` plants them one after another, without and with a flood, and prints a row for each.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.faults.manager import ServiceManager
from tests.processes.frames import frames_in
from tests.processes.harness import Stage
from tests.processes.losses import kernel_drops
from tests.processes.members import CertifiedFleet, is_up
from tests.processes.udp import Client, Sockaddr
from tests.samples import pack
from tests.waiting import PATIENCE_S, until
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.system.guard import EXIT_STATUS, MOST_FAULTS

EVERY_S: Final = 0.02
SETTLE_S: Final = 0.6
BACK_S: Final = 5.0
REACHED_S: Final = 12.0
"""A planted place is reached within this time, or the row fails."""
REKEY_S: Final = 2
FLOOD_EVERY_S: Final = 0.005
FLOOD_DATAGRAMS: Final = 10
"""Garbage that arrives together, 2,000 datagrams a second: several are read at once, and senders take turns."""
VEHICLES: Final = ("v1", "v2", "v3")
CALLED: Final = "v2"
"""The station initiates to this vehicle; the others initiate to the station."""
CALLER: Final = "v3"
RUN: Final = "import runpy; runpy.run_module('tests.faults.plants', run_name='__main__')"


@dataclass(frozen=True, slots=True)
class Place:
    """Where an exception is planted."""

    file: str
    function: str
    event: str = "call"
    who: str = ""
    """The vehicle whose work fails; empty if the place works for all."""
    trigger: str = ""
    """What makes the daemon come there. See :meth:`Scene._trigger`."""
    times: int = 1
    stops: bool = False
    """Whether work stands still afterwards, until the watchdog ends the process."""
    together: int = 0
    """Most frames of others that are lost because one read had their datagrams too."""


def _of(who: str, file: str, *functions: str, event: str = "call", trigger: str = "") -> list[Place]:
    return [Place(file, function, event, who, trigger) for function in functions]


PLACES: Final[Sequence[Place]] = (
    # A datagram in: read, unwrapped, opened, answered.
    Place("io/reader.py", "Reader._on_readable"),
    Place("io/reader.py", "Reader._on_several"),
    Place("daemon/line.py", "Line.receive", together=len(VEHICLES)),
    Place("protocol/receive.py", "DatagramReceiver.receive"),
    *_of(CALLED, "protocol/receive.py", "_receive_other", "_receive_echo", "_reply"),
    *_of(CALLED, "protocol/receive.py", "DatagramReceiver.receive", event="return"),
    *_of(CALLED, "protocol/receive.py", "_receive_record", trigger="bulletin"),
    Place("protocol/session.py", "Session.open", "return"),
    Place("protocol/receive_handshake.py", "HandshakeReceiver.receive"),
    Place("protocol/receive_handshake.py", "HandshakeReceiver.receive", "return"),
    *_of(CALLER, "protocol/establish.py", "answer", "adopt"),
    *_of(CALLER, "protocol/establish.py", "answer", "adopt", event="return"),
    *_of(CALLED, "protocol/establish.py", "receive_response", "adopt"),
    *_of(CALLED, "protocol/establish.py", "receive_response", "adopt", event="return"),
    *_of(CALLED, "protocol/establish.py", "receive_close", trigger="restart"),
    # Outputs.
    Place("daemon/line.py", "Line.perform"),
    Place("daemon/carrier.py", "FrameCarrier._on_record", trigger="bulletin"),
    *_of(CALLED, "daemon/carrier.py", "FrameCarrier._on_event", trigger="restart"),
    *_of(CALLED, "fleet/members.py", "FleetMembers.on_event", trigger="restart"),
    *_of(CALLED, "relay/service.py", "RelayService.on_event", trigger="restart"),
    *_of(CALLED, "relay/clients.py", "Relays.on_event", trigger="restart"),
    *_of(CALLED, "observe/event_log.py", "EventLog.write", trigger="restart"),
    *_of(CALLED, "daemon/peer_link.py", "PeerLink.on_down", trigger="restart"),
    *_of(CALLED, "daemon/peer_link.py", "PeerLink.follow_paths"),
    Place("mavlink/frames.py", "parse_frames"),
    # Frames: policy, routes, clients.
    Place("daemon/line.py", "Line.forward"),
    Place("daemon/switch.py", "Switch.route", trigger="udp"),
    *_of(CALLED, "protocol/send.py", "send_payloads"),
    *_of(CALLED, "protocol/send.py", "send_frames", event="return"),
    Place("protocol/session.py", "Session.seal"),
    Place("protocol/session.py", "Session.seal", "return"),
    Place("io/udp_clients.py", "DatagramEndpoint.take"),
    Place("io/udp_clients.py", "UdpPort.send"),
    Place("io/udp.py", "UdpServer._admit", trigger="udp"),
    Place("daemon/local_endpoints.py", "LocalEndpoints.on_port_opened", trigger="tcp"),
    Place("daemon/local_endpoints.py", "LocalEndpoints.on_port_opened", "return", trigger="tcp"),
    Place("daemon/local_endpoints.py", "LocalEndpoints.on_port_closed", trigger="tcp"),
    Place("io/tcp.py", "TcpServer.on_acceptable", trigger="tcp"),
    Place("io/stream_endpoint.py", "Connection.on_readable", trigger="tcp"),
    Place("io/stream_endpoint.py", "Connection.send", trigger="tcp"),
    Place("io/stream_endpoint.py", "Connection._write_committed", "return", trigger="tcp"),
    Place("io/stream_endpoint.py", "StreamEndpoint.forget", trigger="tcp"),
    # Timers.
    Place("protocol/node.py", "Node.handle_next"),
    *_of(CALLED, "protocol/timeouts.py", "handle_timeout", "_initiate"),
    *_of(CALLED, "protocol/timeouts.py", "handle_timeout", "_initiate", event="return"),
    *_of(CALLED, "protocol/establish.py", "initiate", event="return"),
    *_of(CALLED, "protocol/freshness.py", "handle_timeout"),
    *_of(CALLED, "protocol/probing.py", "update"),
    *_of(CALLED, "protocol/probing.py", "update", event="return"),
    Place("fleet/members.py", "FleetMembers.do_due", trigger="bulletin"),
    # Once a second.
    *_of(CALLED, "daemon/peer_link.py", "PeerLink.measure", "PeerLink.report_refusals", "PeerLink.report_problems"),
    Place("daemon/daemon.py", "Daemon._report"),
    Place("daemon/peer_sockets.py", "PeerSockets.do_housekeeping"),
    Place("daemon/local_endpoints.py", "LocalEndpoints.do_housekeeping"),
    Place("io/udp.py", "UdpServer.do_housekeeping"),
    Place("relay/service.py", "RelayService.do_housekeeping"),
    Place("relay/service.py", "RelayService.settle"),
    Place("observe/findings.py", "find"),
    Place("observe/drop_log.py", "DropLog.check"),
    # The relay, the disk, and requests.
    Place("relay/forwarding.py", "Forwarding.take"),
    Place("authority/state_file.py", "write", trigger="bulletin"),
    Place("authority/state_file.py", "write", "return", trigger="bulletin"),
    Place("fleet/members.py", "FleetMembers._on_written", trigger="bulletin"),
    Place("observe/status.py", "daemon_status", trigger="status"),
    # Again and again, in the middle of a reload, and before a timer could set itself again.
    Place("protocol/node.py", "Node.handle_next", times=MOST_FAULTS),
    Place("daemon/line.py", "Line.forward", who=CALLED, times=MOST_FAULTS),
    Place("protocol/receive.py", "_receive_other", who=CALLED, times=MOST_FAULTS),
    Place("daemon/peers.py", "Peers.follow", trigger="reload"),
    Place("daemon/carrier.py", "FrameCarrier._on_timer"),
    Place("daemon/daemon.py", "Daemon._do_housekeeping", stops=True),
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a planted exception did."""

    place: Place
    hits: int
    end: str
    """How the process ended, if it did."""
    lost: int
    """Frames of the link or client that failed."""
    lost_others: int
    """Frames of all others, in both directions, around the exception and until all had settled."""
    back_s: float
    """Until a frame sent after the exception had arrived, for each vehicle in both directions."""
    explained: int
    """Frames that full sockets of this machine lost meanwhile: no process read them in time."""

    @property
    def is_right(self) -> bool:
        """Whether the fault cost only its own, or the process ended."""
        is_whole = self.lost_others <= max(self.explained, self.place.together) and self.back_s <= BACK_S
        return self.hits >= 1 and (bool(self.end) or (is_whole and not self.place.stops))

    def row(self) -> str:
        """The row of a table."""
        place = self.place
        times = f", {place.times} times" if place.times > 1 else ""
        where = f"| {place.event} of `{place.function}` in `{place.file}`{times} | {place.who or 'all'} |"
        if self.end:
            return f"{where} all | all | {self.end} |"
        lost = "it restarted" if place.trigger == "restart" else self.lost
        why = "of the same read" if place.together else "by full sockets"
        others = f"{self.lost_others} ({why})" if self.lost_others else "0"
        return f"{where} {lost} | {others} | {self.back_s:.2f} s |"


class Party:
    """A client that says numbered heartbeats in a steady rhythm, and notes those of others."""

    def __init__(self, client: Client, into: Sockaddr, system: int) -> None:
        self.into = into
        self.sent_at: list[float] = []
        self.heard_at: dict[bytes, float] = {}
        self._client = client
        self._system = system
        self._noted = 0

    def speak(self) -> None:
        """Say the next frame."""
        with suppress(OSError):  # the daemon ended, and its port is closed
            self._client.send(heartbeat(self._system, len(self.sent_at)), self.into)
        self.sent_at.append(monotonic())

    def listen(self) -> None:
        """Note what has come since."""
        arrived = zip(self._client.arrived_at[self._noted :], self._client.datagrams[self._noted :], strict=True)
        for at, datagram in arrived:
            self._noted += 1
            for raw in frames_in(datagram):
                self.heard_at.setdefault(raw, at)

    def sent_between(self, since: float, before: float) -> list[bytes]:
        """The frames that it said in this time."""
        numbers = (number for number, at in enumerate(self.sent_at) if since <= at < before)
        return [heartbeat(self._system, number) for number in numbers]


def heartbeat(system: int, number: int) -> bytes:
    """A frame that differs from that of every other number."""
    return pack(mavlink.MAVLink_heartbeat_message(2, 8, 0, number, 4, 3), system, seq=number)


class Scene:
    """A ground station that is the relay of its fleet too, three vehicles, and their clients. All of them talk."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.fleet = CertifiedFleet()
        self.ground = stage.daemon("ground")
        self.vehicles = {name: stage.daemon(name) for name in VEHICLES}
        self.manager = ServiceManager(stage.folder / "notify", self.ground)
        self._parties: dict[str, Party] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._tcp: asyncio.StreamWriter | None = None
        self._tcp_port = free_port()

    async def start(self, *, floods: bool) -> None:
        """Start everything; returns when all frames pass."""
        ground = self.ground
        ground.code, ground.is_planted = RUN, True
        ground.environ |= self.manager.environ
        self.fleet.join(ground, MemberRole.OPERATOR, 255)
        ground.config["relay_server"] = {}
        ground.config["endpoint"].append({"name": "tcp", "url": f"tcpin:127.0.0.1:{self._tcp_port}"})
        self._parties["ground"] = Party(await self.stage.client(), ground.add_endpoint("screen"), 255)
        for number, vehicle in enumerate(self.vehicles.values(), 1):
            self.fleet.join(vehicle, MemberRole.VEHICLE, number)
            if vehicle.name != CALLED:  # these have a link with each other too, along the relay
                self.fleet.add_contact(vehicle, ground, [ground.address])
                vehicle.config["contact"][0]["relays"] = True
                vehicle.config["fleet"]["call"] = ["operator", "vehicle"]
            into = vehicle.add_endpoint("autopilot")
            self._parties[vehicle.name] = Party(await self.stage.client(), into, number)
        self.fleet.add_contact(ground, self.vehicles[CALLED], [self.vehicles[CALLED].address])
        for daemon in (ground, *self.vehicles.values()):
            daemon.config["link"]["rekey_after_s"] = REKEY_S
        await self.stage.start(ground, *self.vehicles.values(), linked=False)
        self._tasks = [asyncio.create_task(self._talk()), asyncio.create_task(self.manager.watch())]
        if floods:
            self._tasks.append(asyncio.create_task(self._flood(await self.stage.client())))
        await self._until_settled()

    def stop(self) -> None:
        """No more frames."""
        for task in self._tasks:
            task.cancel()
        if self._tcp is not None:
            self._tcp.close()
        self.manager.close()

    async def _until_settled(self) -> None:
        await self.ground.until(lambda status: is_up(status, *VEHICLES))
        began = monotonic()
        await until(lambda: self._back_s(began) is not None)
        await asyncio.sleep(2 * SETTLE_S)

    async def _talk(self) -> None:
        while True:
            for party in self._parties.values():
                party.speak()
            await asyncio.sleep(EVERY_S)

    async def _flood(self, stranger: Client) -> None:
        while True:
            for number in range(FLOOD_DATAGRAMS):
                with suppress(OSError):
                    stranger.send(bytes((4, number)) * 60, self.ground.sockaddr)
            await asyncio.sleep(FLOOD_EVERY_S)

    # What arrives.

    def _back_s(self, since: float) -> float | None:
        """When the first frame said after this moment had passed, for every vehicle in both directions."""
        for party in self._parties.values():
            party.listen()
        latest, ground = 0.0, self._parties["ground"]
        for vehicle in map(self._parties.__getitem__, VEHICLES):
            for speaker, listener in ((vehicle, ground), (ground, vehicle)):
                said = speaker.sent_between(since, monotonic())
                heard = [listener.heard_at[raw] for raw in said if raw in listener.heard_at]
                if not heard:
                    return None
                latest = max(latest, min(heard) - since)
        return latest

    def _lost(self, since: float, before: float) -> Counter[str]:
        """Lost frames by the vehicle whose link they were for. What no vehicle got is the station's own client's."""
        lost, ground = Counter[str](), self._parties["ground"]
        for raw in ground.sent_between(since, before):
            missing = [name for name in VEHICLES if raw not in self._parties[name].heard_at]
            lost.update(["client"] if len(missing) == len(VEHICLES) else missing)
        for name in VEHICLES:
            lost[name] += sum(raw not in ground.heard_at for raw in self._parties[name].sent_between(since, before))
        return lost

    # Plants.

    async def plant(self, place: Place) -> Outcome:
        """Plant one exception, have the daemon come there, and see what it cost."""
        ground = self.ground
        full = self._drops_of_sockets()
        await ground.ask(f"plant {place.file} {place.function} {place.event} {place.times} {place.who}")
        triggering = asyncio.create_task(self._trigger(place.trigger))
        hits, at = await self._until_planted(place.times)
        since = max(at, await triggering)
        if place.stops:
            await until(lambda: not ground.is_running)
        if not ground.is_running:
            status, ended_s = await ground.ended(), monotonic() - at
            assert status in (EXIT_STATUS, -signal.SIGABRT), "\n".join(ground.lines[-50:])
            how = f"ended with status {status}" if status > 0 else f"ended by the watchdog, {ended_s:.1f} s later"
            await ground.start()
            await self._until_settled()
            return Outcome(place, max(1, hits), how, 0, 0, 0.0, 0)
        await until(lambda: self._back_s(since) is not None)
        back_s = self._back_s(since) or 0.0
        end = max(since + max(back_s, SETTLE_S), monotonic())
        await until(lambda: self._back_s(end) is not None)
        lost = self._lost(at - SETTLE_S, end)
        failing = place.who or (CALLED if place.trigger == "restart" else max(lost, key=lambda name: lost[name]))
        others = lost.total() - lost[failing]
        return Outcome(place, hits, "", lost[failing], others, back_s, self._drops_of_sockets() - full)

    def _drops_of_sockets(self) -> int:
        return sum(kernel_drops(daemon) for daemon in (self.ground, *self.vehicles.values()) if daemon.is_running)

    async def _until_planted(self, times: int) -> tuple[int, float]:
        """How often it was raised, and when first."""
        give_up_at, hits, at = monotonic() + REACHED_S, 0, monotonic()
        while hits < times and monotonic() < give_up_at and self.ground.is_running:
            with suppress(OSError, ValueError):
                answer = await self.ground.ask("planted")
                hits, at = int(answer["hits"]), answer["at"] or at
            await asyncio.sleep(EVERY_S)
        return hits, at

    async def _trigger(self, trigger: str) -> float:
        """Do what makes the daemon come to a place. Returns when it was done."""
        ground, vehicle = self.ground, self.vehicles[CALLED]
        with suppress(OSError, ValueError):  # the daemon ends meanwhile
            match trigger:
                case "bulletin":
                    await ground.ask(self.fleet.raise_least(1))
                case "reload":
                    ground.config["link"]["keepalive_s"] = 9
                    ground.write_config()
                    await ground.ask("reload")
                case "udp":  # a new client
                    client = await self.stage.client()
                    for number in range(10):
                        client.send(heartbeat(250, number), self._parties["ground"].into)
                        await asyncio.sleep(EVERY_S)
                case "tcp":  # two, the second in place of the first
                    for _ in range(2):
                        await self._connect()
                case "status":
                    await ground.status()
                case "restart":
                    await vehicle.stop()
                    await vehicle.start()
                    await vehicle.ready()
                    ready_at = monotonic()
                    await vehicle.until(lambda status: is_up(status, "ground"))
                    await asyncio.sleep(2 * SETTLE_S)
                    return ready_at
        return 0.0

    async def _connect(self) -> None:
        if self._tcp is not None:
            self._tcp.close()
        _, self._tcp = await asyncio.open_connection("127.0.0.1", self._tcp_port)
        self._tcp.write(heartbeat(251, 1))
        await asyncio.sleep(5 * EVERY_S)


async def measure(places: Sequence[Place], *, floods: bool) -> list[Outcome]:
    """Plant each in the same daemon, one after the other."""
    outcomes: list[Outcome] = []
    async with Stage() as stage:
        scene = Scene(stage)
        try:
            await scene.start(floods=floods)
            for place in places:
                async with asyncio.timeout(PATIENCE_S):
                    outcomes.append(await scene.plant(place))
                print(outcomes[-1].row(), "" if outcomes[-1].is_right else "WRONG", file=sys.stderr, flush=True)
        finally:
            scene.stop()
    return outcomes


async def _main() -> None:
    for floods in (False, True):
        await measure(PLACES, floods=floods)


if __name__ == "__main__":
    asyncio.run(_main())
