"""Real daemons behind NATs that know only a relay, while a NAT forgets, a network dies, or the relay starts again."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import partial
from time import monotonic
from types import MappingProxyType
from typing import Final

from tests.faults.talk import CriticalVoice, Talk, Voice
from tests.natlab.daemons import PORT, RELAY, Ends, make_ends, make_relay, until_direct
from tests.natlab.laboratory import SECOND, Laboratory, Place
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from tests.waiting import until

DELAY_S: Final = 0.025
"""Of each place's line, in each direction: a round trip of 100 ms along the relay."""
SETTLE_S: Final = 3.0
COUNTED_S: Final = 2.0
"""How long losses are counted after the link is back."""
DIRECT_S: Final = 10.0
NAMED: Final = "relay.natlab.test"


@dataclass(frozen=True, slots=True)
class Outcome:
    back_s: float
    """From the fault until a frame that was sent after it had arrived, in each direction."""
    sent: int
    """In both directions, from half a second before the fault until :data:`COUNTED_S` after the link was back."""
    lost: int
    """Of those."""


class Scene:
    """A relay on the internet and two daemons that talk."""

    def __init__(self, laboratory: Laboratory, stage: Stage) -> None:
        self.laboratory = laboratory
        self.stage = stage
        self.public = laboratory.public()
        self.relay = make_relay(stage, self.public)
        self.ends: Ends

    @property
    def talk(self) -> Talk:
        return self.ends.talk

    def place(self, kind: str) -> Place:
        return self.laboratory.place(kind, delay_s=DELAY_S)

    def join(self, places: tuple[Place, Place], voice: type[Voice] = Voice) -> None:
        self.ends = make_ends(self.stage, self.relay, places, PORT + 1, voice)

    async def start(self) -> None:
        """Start everything, and wait until the daemons are linked."""
        await self.stage.start(self.relay, linked=False)
        await self.stage.start(*self.ends.daemons)

    async def start_relay_again(self) -> float:
        """Start the relay that was killed. Returns when it was ready."""
        await self.relay.start()
        await until(lambda: len(self.relay.events("daemon_started")) == 2)
        return monotonic()

    async def judge(self, began: float) -> Outcome:
        """Wait until the link is back, and count."""
        back_s = await self.talk.elapsed_until_back(began)
        since, before = began - 0.5, monotonic() + COUNTED_S
        await asyncio.sleep(COUNTED_S)
        await self.talk.back(before)
        sent = sum(len(voice.sent_between(since, before)) for voice in self.talk.voices)
        return Outcome(back_s, sent, self.talk.lost(since, before))


async def filtered_nat_forgets(scene: Scene, voice: type[Voice] = Voice) -> Outcome:
    """One end's NAT forgets its mappings under a direct link: its next datagram gets another port.

    The other one's NAT filters by port, so both have to ask again. It is direct again then.
    """
    places = scene.place("port-restricted"), scene.place("port-restricted")
    scene.join(places, voice)
    await scene.start()
    await scene.talk.start()
    assert await until_direct(scene.ends.daemons, DIRECT_S) is not None
    await asyncio.sleep(SETTLE_S)
    places[0].forget()
    outcome = await scene.judge(monotonic())
    assert await until_direct(scene.ends.daemons, DIRECT_S) is not None
    return outcome


async def one_network_dies(scene: Scene) -> Outcome:
    """The vehicle has two networks, the station one, each behind a NAT. That of the stream dies. Critical frames."""
    vehicle = scene.place("symmetric")
    vehicle.second_network("linux-random")
    scene.join((vehicle, scene.place("carrier-symmetric")), CriticalVoice)
    daemon, station = scene.ends.daemons
    daemon.config["network"] = [{"name": device, "interface": device} for device in ("wan", SECOND)]
    await scene.start()
    await scene.talk.start()
    for one in (daemon, station):
        await one.until(lambda status: len(_usable(status)) >= 2)
    await asyncio.sleep(SETTLE_S)
    best = _usable(await daemon.status())[0]
    vehicle.host.ip(f"link set {best['network']} down")
    outcome = await scene.judge(monotonic())
    status = await daemon.status()
    assert [name for name, network in status["networks"].items() if not network["is_present"]] == [best["network"]]
    return outcome


def _usable(status: Status) -> list[Status]:
    (peer,) = status["peers"].values()
    return [path for path in peer["paths"] if path["relay"] == RELAY and path["state"] == "usable"]


async def member_roams(scene: Scene) -> Outcome:
    """A member without ``[[network]]`` gets another network, behind another NAT."""
    member = scene.place("symmetric")
    member.second_network("linux-random")
    scene.join((member, scene.place("carrier-symmetric")))
    await scene.start()
    await scene.talk.start()
    await asyncio.sleep(SETTLE_S)
    member.host.ip("link set wan down")
    return await scene.judge(monotonic())


async def relay_restarts(scene: Scene) -> Outcome:
    """The relay is killed, and starts again."""
    scene.join((scene.place("symmetric"), scene.place("carrier-symmetric")))
    await scene.start()
    await scene.talk.start()
    await asyncio.sleep(SETTLE_S)
    await scene.relay.kill()
    return await scene.judge(await scene.start_relay_again())


async def relay_moves(scene: Scene) -> Outcome:
    """The relay is killed, and starts again at another address. Its name is changed at the same time."""
    scene.join((scene.place("symmetric"), scene.place("carrier-symmetric")))
    hosts = scene.stage.folder / "hosts"
    hosts.write_text(f"{scene.public.address} {NAMED}\n")
    for daemon in scene.ends.daemons:
        _name(daemon, str(hosts))
    await scene.start()
    await scene.talk.start()
    await asyncio.sleep(SETTLE_S)
    await scene.relay.kill()
    scene.relay.config["listen"] = [f"{scene.public.second_address}:{PORT}"]
    hosts.write_text(f"{scene.public.second_address} {NAMED}\n")
    return await scene.judge(await scene.start_relay_again())


def _name(daemon: DaemonProcess, hosts: str) -> None:
    """Give a daemon a file of hosts of its own, and the relay's name instead of its address."""
    script = f"mount --bind '{hosts}' /etc/hosts && exec \"$@\""
    daemon.launcher = (*daemon.launcher, "unshare", "--mount", "sh", "-c", script, "sh")
    daemon.config["relay"][0]["addresses"] = [f"{NAMED}:{PORT}"]


FAULTS: Final[Mapping[str, Callable[[Scene], Awaitable[Outcome]]]] = MappingProxyType(
    {
        "a NAT forgets, direct, both filter by port": filtered_nat_forgets,
        "the same, critical frames": partial(filtered_nat_forgets, voice=CriticalVoice),
        "one of two networks dies, critical frames": one_network_dies,
        "a member roams": member_roams,
        "the relay is killed and starts": relay_restarts,
        "the relay starts at another address": relay_moves,
    }
)


async def play(fault: Callable[[Scene], Awaitable[Outcome]], laboratory: Laboratory) -> Outcome:
    async with Stage() as stage:
        scene = Scene(laboratory, stage)
        try:
            return await fault(scene)
        finally:
            scene.talk.stop()
