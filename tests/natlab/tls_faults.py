"""A relay by TLS while UDP is dropped at the vehicle, a connection is reset, or a network or the relay is away."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from time import monotonic
from typing import Final

from tests.faults.talk import Talk, Voice
from tests.natlab.daemons import PORT, make_ends, make_relay
from tests.natlab.laboratory import Laboratory
from tests.processes.frames import command_long
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from tests.processes.tls import listen_for_tls
from tests.samples import number_value
from tests.waiting import until

UDP, TLS = "udp", "tls"
NO_UDP: Final = "ip saddr V meta l4proto udp drop", "ip daddr V meta l4proto udp drop"
DELAY_S: Final = 0.025
"""Of the vehicle's line, in each direction."""
AWAY_S: Final = 6.0
OUTAGE_S: Final = 3.0
ABSENT_S: Final = 1.4
SETTLE_S: Final = 5.0
LATE_S: Final = 3.0
"""Frames that arrive later than this after the last one was sent count as lost."""
FLOWS: Final = 25
"""Telemetry comes from so many components: newer states replace older ones of the same component."""


class Mixed(Voice):
    """A client that sends 25 commands and 25 states a second: commands have even numbers."""

    def frame(self, number: int) -> bytes:
        if number % 2 == 0:
            return command_long(400, self.system, (3 - self.system, 1), seq=number, param1=float(number))
        return number_value(number, self.system, 1 + number // 2 % FLOWS).raw


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

    def __init__(self, laboratory: Laboratory, stage: Stage) -> None:
        public = laboratory.public()
        places = laboratory.place("open", delay_s=DELAY_S), laboratory.place("open")
        self.host = places[0].host
        self.relay = make_relay(stage, public)
        url = listen_for_tls(self.relay, public.address, 443)
        self.ends = make_ends(stage, self.relay, places, PORT + 1, Mixed)
        for daemon in self.ends.daemons:
            daemon.config["relay"][0]["addresses"] = [self.relay.address, url]
        self.away_s = 0.0
        self._internet = laboratory.internet
        self._addresses = [place.address for place in places]

    @property
    def vehicle(self) -> DaemonProcess:
        return self.ends.daemons[0]

    @property
    def talk(self) -> Talk:
        return self.ends.talk

    def filter(self, *rules: str) -> None:
        """Apply these rules to all packets from now on. V is the vehicle's address."""
        vehicle, station = self._addresses
        rules = tuple(rule.replace("V", vehicle) for rule in rules)
        text = "\n".join((f"ip saddr {vehicle} ip daddr {station} drop", *rules))
        chain = f"chain c {{ type filter hook forward priority filter;\n{text}\n}}"
        self._internet.nft(f"flush ruleset\ntable inet t {{\n{chain}\n}}")

    @contextmanager
    def away(self) -> Iterator[None]:
        """The network or the relay is away."""
        began = monotonic()
        yield
        self.away_s = monotonic() - began

    async def until_by(self, kind: str) -> None:
        """Wait until the vehicle sends by UDP or by TLS."""
        await self.vehicle.until(lambda status: _carrier(status) == kind)

    def outcome(self, since: float, before: float) -> Outcome:
        """What happened to the frames that were sent in between."""
        gaps, sent, lost = [0.0], 0, list[int]()
        for speaker, hearer in (self.talk.voices, self.talk.voices[::-1]):
            arrivals = sorted(at for at in hearer.received_at.values() if since < at < before)
            gaps += [later - at for at, later in pairwise([since, *arrivals, before])]
            numbers = speaker.sent_between(since, before)
            sent += len(numbers)
            lost += [number for number in numbers if speaker.frame(number) not in hearer.received_at]
        return Outcome(sent, len(lost), sum(number % 2 == 0 for number in lost), max(gaps), self.away_s)


Fault = Callable[[Scene], Awaitable[None]]


async def udp_goes_and_returns(scene: Scene) -> None:
    """UDP is dropped at the vehicle for some seconds, and then passes again."""
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
    with scene.away():
        await scene.relay.kill()
        await asyncio.sleep(ABSENT_S)
        await scene.relay.start()
        await until(lambda: len(scene.relay.events("daemon_started")) == 2)
    await scene.until_by(TLS)


FAILURES: Final[Mapping[str, tuple[Fault, Sequence[str]]]] = {
    "UDP goes and returns": (udp_goes_and_returns, ()),
    "the connection is reset": (connection_is_reset, NO_UDP),
}
"""Each with the rules before it."""
OUTAGES: Final[Mapping[str, Fault]] = {
    "the network drops all for 3 s": network_drops,
    "the interface is down for 3 s": interface_is_down,
    "the relay is absent for 1.4 s": relay_is_absent,
}


async def fail(fault: Fault, rules: Sequence[str]) -> Outcome:
    """Both ends talk, with 5 s before and after the fault, under these rules until then."""
    with Laboratory() as laboratory:
        async with Stage() as stage:
            scene = Scene(laboratory, stage)
            scene.filter(*rules)
            try:
                await stage.start(scene.relay, linked=False)
                await stage.start(*scene.ends.daemons)
                await scene.talk.start()
                await asyncio.sleep(SETTLE_S)
                began = monotonic()
                await fault(scene)
                await asyncio.sleep(SETTLE_S)
                before = monotonic()
                await asyncio.sleep(LATE_S)
                return scene.outcome(began, before)
            finally:
                scene.talk.stop()


def _carrier(status: Status) -> str:
    """Of the vehicle's best path to the station."""
    (peer,) = status["peers"].values()
    return TLS if str(peer["paths"][0]["relay_address"]).startswith("wss:") else UDP
