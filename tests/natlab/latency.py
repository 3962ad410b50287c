"""Commands beside telemetry along a relay, by UDP and by TLS: how old they arrive, and what failures lose."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from time import monotonic
from typing import Final, NamedTuple

from tests.namespaces import udp_socket_in
from tests.natlab.daemons import make_member, make_relay
from tests.natlab.laboratory import Laboratory
from tests.natlab.talkers import COMMAND, TELEMETRY, Ages, Rates, Talker, ages
from tests.processes.harness import Stage
from tests.processes.process import Status
from tests.processes.tls import listen_for_tls
from tests.waiting import until

NAMES: Final = "vehicle", "station"
VEHICLE, STATION = 1, 2
"""Their systems."""
UDP, TLS = "udp", "tls"
NO_UDP: Final = "ip saddr V meta l4proto udp drop", "ip daddr V meta l4proto udp drop"
AWAY_S: Final = 15.0
OUTAGE_S: Final = 3.0
ABSENT_S: Final = 1.4
SETTLE_S: Final = 5.0
LATE_S: Final = 3.0
"""Frames that arrive later than this after the last one was sent count as lost."""
ENDLESS: Final = """
import sys
from math import inf
from uavlinkd.io import send_window
from uavlinkd.tls import channel as tls_channel
from uavlinkd.tls import stream as web_stream
from uavlinkd.tls import relays as web_relays
web_stream.QUEUE_S, web_stream.QUEUE_BYTES, tls_channel.UNSENT_BYTES = inf, inf, inf
tls_channel._OPTIONS = [one for one in tls_channel._OPTIONS if one[1] != "TCP_NOTSENT_LOWAT"]
send_window.SendWindow.is_open = True
web_relays.WebGate.level = lambda gate, now: float(1 << 30)
from uavlinkd.cli import main
sys.exit(main())
"""
"""A daemon whose stream takes everything, as DERP does: nothing limits the bytes that wait there."""
CARRIERS: Final = {"UDP": (UDP, False), "TLS": (TLS, False), "TLS without limits": (TLS, True)}
"""The title of each, and whether the daemons are :data:`ENDLESS`."""


class Line(NamedTuple):
    """Between the vehicle and the internet."""

    delay_s: float = 0.025
    loss: float = 0.0
    kbit_s: int = 0
    """What it carries from the vehicle; 0: no limit. Its modem lets packets wait for a second."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of a fault: the frames of all and of those that were commands, and the longest gap between two that arrived."""

    sent: int
    lost: int
    commands_lost: int
    gap_s: float
    away_s: float
    """How long the network or the relay was away."""


class Scene:
    """A relay that listens for TLS, a vehicle behind a line, and a station. They reach each other only along it."""

    def __init__(self, laboratory: Laboratory, stage: Stage, line: Line, rates: tuple[Rates, Rates]) -> None:
        public = laboratory.public()
        places = laboratory.place("open", delay_s=line.delay_s, loss=line.loss), laboratory.place("open")
        self.host = places[0].host
        self._internet = laboratory.internet
        self._addresses = [place.address for place in places]
        if line.kbit_s:
            limit = f"tbf rate {line.kbit_s}kbit burst 3000 latency 1s"
            places[0].nodes[0].namespace.run("tc", "qdisc", "add", "dev", "wan", "root", *limit.split())
        relay = make_relay(stage, public)
        url = listen_for_tls(relay, public.address, 443)
        ends = [
            make_member(stage, relay, name, ["0.0.0.0:5790"], place)
            for name, place in zip(NAMES, places, strict=True)
        ]
        self.vehicle, station = ends
        psk = stage.psk()
        self.vehicle.add_peer(station, [], psk)
        station.add_peer(self.vehicle, [], psk)
        self.daemons = relay, self.vehicle, station
        self.talkers = []
        for end, place, system, rate in zip(ends, places, (VEHICLE, STATION), rates, strict=True):
            end.config["relay"][0]["addresses"] = [relay.address, url]
            into = end.add_endpoint("client")
            self.talkers.append(Talker(udp_socket_in(place.host.path), into, system, rate))
        self.away_s = 0.0
        self._stage = stage

    def filter(self, *rules: str) -> None:
        """Apply these rules to all packets from now on. V is the vehicle's address."""
        vehicle, station = self._addresses
        rules = tuple(rule.replace("V", vehicle) for rule in rules)
        text = "\n".join((f"ip saddr {vehicle} ip daddr {station} drop", *rules))
        chain = f"chain c {{ type filter hook forward priority filter;\n{text}\n}}"
        self._internet.nft(f"flush ruleset\ntable inet t {{\n{chain}\n}}")

    @asynccontextmanager
    async def talking(self) -> AsyncIterator[None]:
        """Both clients talk, and each has received the other."""
        relay, *members = self.daemons
        await self._stage.start(relay, linked=False)
        await self._stage.start(*members)
        tasks = [asyncio.create_task(talker.talk()) for talker in self.talkers]
        try:
            await until(lambda: all(talker.received for talker in self.talkers))
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    @contextmanager
    def away(self) -> Iterator[None]:
        """The network or the relay is away."""
        began = monotonic()
        yield
        self.away_s = monotonic() - began

    async def until_by(self, kind: str) -> None:
        """Wait until the vehicle sends by UDP or by TLS."""
        await self.vehicle.until(lambda status: _carrier(status) == kind)

    def ages(self, kind: str, since: float, before: float) -> tuple[Ages, Ages]:
        """From the vehicle, and to it."""
        vehicle, station = self.talkers
        return ages(vehicle, station, kind, since, before), ages(station, vehicle, kind, since, before)


async def measure(line: Line, by: str, seconds: float, *, is_endless: bool = False) -> dict[str, Ages]:
    """The ages of commands in both directions, and of the telemetry beside them."""
    rates = {COMMAND: 10, TELEMETRY: 1190}, {COMMAND: 10}
    with Laboratory() as laboratory:
        async with Stage() as stage:
            scene = Scene(laboratory, stage, line, rates)
            for daemon in scene.daemons:
                daemon.code = ENDLESS if is_endless else ""
            scene.filter(*(NO_UDP if by == TLS else ()))
            async with scene.talking():
                await asyncio.sleep(SETTLE_S)
                began = monotonic()
                await asyncio.sleep(seconds)
                before = monotonic()
                await scene.until_by(by)
                await asyncio.sleep(LATE_S)
                sent, received = scene.ages(COMMAND, began, before)
                telemetry, _ = scene.ages(TELEMETRY, began, before)
    return {"commands to the vehicle": received, "commands from it": sent, "its telemetry": telemetry}


async def udp_goes_and_returns(scene: Scene) -> None:
    """UDP is dropped at the vehicle for 15 s, and then passes again."""
    await scene.until_by(UDP)
    scene.filter(*NO_UDP)
    await asyncio.sleep(AWAY_S)
    await scene.until_by(TLS)
    scene.filter()
    await scene.until_by(UDP)
    await scene.vehicle.until_logged("relay_disconnected")


async def connection_is_reset(scene: Scene) -> None:
    """UDP is dropped at the vehicle. A firewall resets the TCP connection once."""
    scene.filter(*NO_UDP, "tcp dport 443 reject with tcp reset", "tcp sport 443 reject with tcp reset")
    await scene.vehicle.until_logged("relay_disconnected")
    scene.filter(*NO_UDP)
    await scene.until_by(TLS)


async def network_drops(scene: Scene) -> None:
    """UDP is dropped at the vehicle, and for 3 s everything: neither end's kernel reports it."""
    with scene.away():
        scene.filter("ip saddr V drop", "ip daddr V drop")
        await asyncio.sleep(OUTAGE_S)
        scene.filter(*NO_UDP)
    await scene.until_by(TLS)


async def interface_is_down(scene: Scene) -> None:
    """UDP is dropped at the vehicle. For 3 s its kernel has no interface and no route."""
    route = scene.host.run("ip", "route", "show", "default")
    with scene.away():
        scene.host.ip("link set wan down")
        await asyncio.sleep(OUTAGE_S)
        scene.host.ip("link set wan up", f"route add {route.strip()}")
    await scene.until_by(TLS)


async def relay_is_absent(scene: Scene) -> None:
    """UDP is dropped at the vehicle. The relay is killed, and starts 1.4 s later."""
    relay, *_ = scene.daemons
    with scene.away():
        await relay.kill()
        await asyncio.sleep(ABSENT_S)
        await relay.start()
        await until(lambda: len(relay.events("daemon_started")) == 2)
    await scene.until_by(TLS)


FAULTS: Final = {
    "UDP goes and returns": (udp_goes_and_returns, ()),
    "the connection is reset": (connection_is_reset, NO_UDP),
    "the network drops all for 3 s": (network_drops, NO_UDP),
    "the interface is down for 3 s": (interface_is_down, NO_UDP),
    "the relay is absent for 1.4 s": (relay_is_absent, NO_UDP),
}
"""Each with the rules before it."""


async def fail(name: str, line: Line) -> Outcome:
    """Both ends send 25 commands and 25 states a second, with 5 s before and after the fault."""
    fault, rules = FAULTS[name]
    rates = {COMMAND: 25, TELEMETRY: 25}
    with Laboratory() as laboratory:
        async with Stage() as stage:
            scene = Scene(laboratory, stage, line, (rates, rates))
            scene.filter(*rules)
            async with scene.talking():
                await asyncio.sleep(SETTLE_S)
                began = monotonic()
                await fault(scene)
                await asyncio.sleep(SETTLE_S)
                before = monotonic()
                await asyncio.sleep(LATE_S)
                commands, states = (scene.ages(kind, began, before) for kind in (COMMAND, TELEMETRY))
    every = (*commands, *states)
    return Outcome(
        sum(one.sent for one in every),
        sum(one.lost for one in every),
        sum(one.lost for one in commands),
        max(one.gap_s for one in every),
        scene.away_s,
    )


def _carrier(status: Status) -> str:
    """Of the vehicle's best path to the station."""
    (peer,) = status["peers"].values()
    return TLS if str(peer["paths"][0]["relay_address"]).startswith("wss:") else UDP
