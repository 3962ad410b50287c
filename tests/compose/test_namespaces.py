"""A fleet in network namespaces: what the containers show, on machines without an engine for them."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
import pytest_asyncio

from tests.compose import images, outages
from tests.compose.cluster import SYSTEM_IDS, Cluster, until
from tests.fleet.vehicles import create
from tests.namespaces import Namespace, connect, need_namespaces
from uavlinkd.fleet.manifest import FleetSettings
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.system.addresses import DEFAULT_PORT, Address

pytestmark = pytest.mark.asyncio(loop_scope="module")


class Namespaces(Cluster):
    """A bridge in a namespace of its own, and a namespace with a cable to it for each host."""

    cut_s = outages.OUTAGE_S if images.why_not() else 0.0
    """Where there are containers, they show the long one."""

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

    async def _end(self, name: str, number: signal.Signals) -> int:
        self._daemons[name].send_signal(number)
        return await self._daemons[name].wait()

    async def stop(self, name: str) -> None:
        assert await self._end(name, signal.SIGTERM) == 0

    async def kill(self, name: str) -> None:
        await self._end(name, signal.SIGKILL)

    async def pause(self, name: str) -> None:
        self._daemons[name].send_signal(signal.SIGSTOP)

    async def resume(self, name: str) -> None:
        self._daemons[name].send_signal(signal.SIGCONT)

    async def cut(self, name: str) -> None:
        self._air.ip(f"link set to-{SYSTEM_IDS[name]} down")

    async def join(self, name: str, *, elsewhere: bool = False) -> None:
        if elsewhere:
            self._hosts[name].ip("address flush dev eth0", "address add 10.13.0.77/24 dev eth0")
        self._air.ip(f"link set to-{SYSTEM_IDS[name]} up")

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
    await outages.check_frames(cluster)


@pytest.mark.parametrize("outage", outages.OUTAGES.values(), ids=outages.OUTAGES)
async def test_outage_ends_in_time_and_disturbs_no_other_link(
    cluster: Namespaces, outage: Callable[[Cluster], Awaitable[None]]
) -> None:
    """A host that was gone is linked again two seconds after it can be reached; the others lose no frame."""
    await outage(cluster)
