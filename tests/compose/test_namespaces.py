"""A fleet in network namespaces, and what befalls one of its hosts while the others talk."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from tests.compose.cluster import SYSTEM_IDS, Cluster, Conversation, check_frames, until
from tests.fleet.vehicles import create
from tests.namespaces import Namespace, connect, need_namespaces
from uavlinkd.fleet.manifest import FleetSettings
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.system.addresses import DEFAULT_PORT, Address

pytestmark = pytest.mark.asyncio(loop_scope="module")


class Namespaces(Cluster):
    """A bridge in a namespace of its own, and a namespace with a cable to it for each host."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._air = Namespace()
        self._hosts = {name: Namespace() for name in SYSTEM_IDS}
        self._daemons: dict[str, asyncio.subprocess.Process] = {}
        self._processes: list[asyncio.subprocess.Process] = []

    async def open(self) -> None:
        settings = FleetSettings(swarm=True, ground_station_url="udpin:127.0.0.1:14550")
        at = Address(self._address("ground-station"), DEFAULT_PORT)
        create(self._folder / "fleet", settings, drones=3, stations=1, at=[at])
        self._air.open()
        self._air.ip("link add air type bridge", "link set air up")
        for name, host in self._hosts.items():
            host.open()
            cable = f"to-{SYSTEM_IDS[name]}"
            connect(self._air, cable, host, "eth0")
            self._air.ip(f"link set {cable} master air")
            host.ip(f"address add {self._address(name)}/24 dev eth0")
        for name in SYSTEM_IDS:
            await self.start(name)
            if name != "ground-station":
                await self._run(name, "sim", "--system-id", str(SYSTEM_IDS[name]), "--url", "udpout:127.0.0.1:14550")

    async def close(self) -> None:
        for namespace in (self._air, *self._hosts.values()):
            namespace.close()
        for process in self._processes:
            await process.wait()

    def _address(self, name: str) -> str:
        return f"10.13.0.{254 if name == 'ground-station' else SYSTEM_IDS[name]}"

    async def _run(self, name: str, *arguments: str) -> asyncio.subprocess.Process:
        with (self._folder / f"{name}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                *end_with_parent(*self._hosts[name].launcher, sys.executable, "-m", "uavlinkd", *arguments),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self._processes.append(process)
        return process

    def namespace_of(self, name: str) -> Path:
        return self._hosts[name].path

    def control_socket_of(self, name: str) -> Path:
        return self._folder / "fleet" / name / f"{name}.sock"

    async def start(self, name: str) -> None:
        config = self._folder / "fleet" / name / f"{name}.toml"
        self._daemons[name] = await self._run(name, "run", "--config", str(config))

    async def end(self, name: str, number: signal.Signals) -> None:
        """End a daemon as a shutdown or a power failure does."""
        self._daemons[name].send_signal(number)
        assert await self._daemons[name].wait() == (0 if number is signal.SIGTERM else -number)

    async def start_again(self, name: str) -> None:
        """It can be reached once it listens."""
        await self.start(name)
        await until(lambda: self.status(name) is not None, f"{name} listens")

    def signal(self, name: str, number: signal.Signals) -> None:
        self._daemons[name].send_signal(number)

    def set_cable(self, name: str, state: str) -> None:
        """Take the host off the network (``down``), or put it there again (``up``)."""
        self._air.ip(f"link set to-{SYSTEM_IDS[name]} {state}")

    def give_other_address(self, name: str) -> None:
        self._hosts[name].ip("address flush dev eth0", "address add 10.13.0.77/24 dev eth0")

    def is_linked(self, name: str) -> bool:
        states = self.states(name)
        others = [other for other in SYSTEM_IDS if other != name]
        return all(states.get(other) == "up" for other in others) and all(
            self.states(peer).get(name) == "up" for peer in others
        )

    def is_missed(self, name: str) -> bool:
        """Whether all others have noticed that it is gone."""
        states = [self.states(other) for other in SYSTEM_IDS if other != name]
        return all(name in there and there[name] != "up" for there in states)  # not: the daemon was slow to answer

    def logs(self) -> str:
        return "\n".join(f"--- {path.stem}\n{path.read_text()}" for path in sorted(self._folder.glob("*.log")))


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def namespaces(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Namespaces]:
    need_namespaces()
    cluster = Namespaces(tmp_path_factory.mktemp("fleet"))
    try:
        await cluster.open()
        await cluster.until_linked()
        yield cluster
    finally:
        await cluster.close()
        print(cluster.logs())


@pytest_asyncio.fixture(loop_scope="module")
async def cluster(namespaces: Namespaces) -> Namespaces:
    await until(namespaces.are_all_calm, "all links are up, along a path that answers")
    return namespaces


async def test_frames_reach_all_others_once(cluster: Namespaces) -> None:
    """What each vehicle's client says comes to each other's once, byte for byte."""
    await check_frames(cluster)


BACK_S = 2.0
"""From the end of an outage until the link is up, on an idle machine."""
VICTIM = "drone3"
OTHERS = ("drone1", "drone2", "ground-station")


async def begin(cluster: Namespaces, outage: str) -> None:
    match outage:
        case "stopped" | "moved":
            await cluster.end(VICTIM, signal.SIGTERM)
        case "killed":
            await cluster.end(VICTIM, signal.SIGKILL)
        case "paused":
            cluster.signal(VICTIM, signal.SIGSTOP)
        case _:
            cluster.set_cable(VICTIM, "down")


async def end(cluster: Namespaces, outage: str) -> None:
    """Returns once the host can be reached again."""
    match outage:
        case "paused":
            cluster.signal(VICTIM, signal.SIGCONT)
        case "cut off":
            cluster.set_cable(VICTIM, "up")
        case _:
            if outage == "moved":
                cluster.give_other_address(VICTIM)
            await cluster.start_again(VICTIM)


@pytest.mark.parametrize("outage", ["stopped", "killed", "paused", "cut off", "moved"])
async def test_outage_ends_in_time_and_disturbs_no_other_link(cluster: Namespaces, outage: str) -> None:
    """A host that was gone is linked again two seconds after it can be reached; the others lose no frame."""
    took_s = 0.0

    async def happen() -> None:
        nonlocal took_s
        await begin(cluster, outage)
        await until(lambda: cluster.is_missed(VICTIM), f"{VICTIM} is missed")
        await end(cluster, outage)
        took_s = await until(lambda: cluster.is_linked(VICTIM), f"{VICTIM} is back")

    conversation = Conversation(cluster, OTHERS)
    try:
        await conversation.open()
        said = await conversation.during(happen())
        await conversation.check()
    finally:
        conversation.close()
    print(f"back after {took_s:.2f} s; meanwhile each other said {said} frames")
    assert took_s < BACK_S
