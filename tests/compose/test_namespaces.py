"""A fleet in network namespaces: what the containers show, on machines without an engine for them."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
import pytest_asyncio

from tests.compose import images, outages
from tests.compose.cluster import SYSTEM_IDS, Cluster, run, until
from tests.needs import need
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import FleetSettings
from uavlinkd.lab.child_processes import end_with_parent

pytestmark = pytest.mark.asyncio(loop_scope="module")


class Namespaces(Cluster):
    """A bridge in a namespace of its own, and a namespace with a cable to it for each host."""

    cut_s = outages.OUTAGE_S if images.why_not() else 0.0
    """Where there are containers, they show the long one."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._prefix = f"uavlinkd-{os.getpid()}-"
        self._daemons: dict[str, asyncio.subprocess.Process] = {}
        self._autopilots: list[asyncio.subprocess.Process] = []

    async def open(self) -> None:
        """Make the network, and start everything."""
        operations.init(
            self._folder / "fleet", FleetSettings(psk=True, ground_station_url="udpin:127.0.0.1:14550"), 3, 1, 0
        )
        air = self._prefix + "air"
        await run("ip", "netns", "add", air)
        await run("ip", "-n", air, "link", "add", "air", "type", "bridge")
        await run("ip", "-n", air, "link", "set", "air", "up")
        for name in self.names:
            host = self._prefix + name
            await run("ip", "netns", "add", host)
            cable = f"to-{SYSTEM_IDS[name]}"
            await run("ip", "-n", host, "link", "add", "eth0", "type", "veth", "peer", "name", cable, "netns", air)
            await run("ip", "-n", air, "link", "set", cable, "master", "air", "up")
            await run("ip", "-n", host, "link", "set", "lo", "up")
            await run("ip", "-n", host, "link", "set", "eth0", "up")
            await run("ip", "-n", host, "address", "add", f"{self._address(name)}/24", "dev", "eth0")
        for name in self.names:
            await self.start(name)
            if name != "ground-station":
                sim = ["sim", "--system-id", str(SYSTEM_IDS[name]), "--url", "udpout:127.0.0.1:14550"]
                self._autopilots.append(await self._run(name, *sim))

    async def close(self) -> None:
        """End everything; nothing is left."""
        for process in (*self._daemons.values(), *self._autopilots):
            if process.returncode is None:
                process.send_signal(signal.SIGKILL)
                await process.wait()
        for name in ("air", *self.names):
            await run("ip", "netns", "delete", self._prefix + name, check=False)

    def _address(self, name: str) -> str:
        return f"10.13.0.{254 if name == 'ground-station' else SYSTEM_IDS[name]}"

    async def _run(self, name: str, *arguments: str) -> asyncio.subprocess.Process:
        with (self._folder / f"{name}.log").open("ab") as log:
            return await asyncio.create_subprocess_exec(
                *end_with_parent(
                    "ip", "netns", "exec", self._prefix + name, sys.executable, "-m", "uavlinkd", *arguments
                ),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def namespace_of(self, name: str) -> Path:
        return Path("/run/netns") / (self._prefix + name)

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
        await run("ip", "-n", self._prefix + "air", "link", "set", f"to-{SYSTEM_IDS[name]}", "down")

    async def join(self, name: str, *, elsewhere: bool = False) -> None:
        if elsewhere:
            await run("ip", "-n", self._prefix + name, "address", "flush", "dev", "eth0")
            await run("ip", "-n", self._prefix + name, "address", "add", "10.13.0.77/24", "dev", "eth0")
        await run("ip", "-n", self._prefix + "air", "link", "set", f"to-{SYSTEM_IDS[name]}", "up")

    def logs(self) -> str:
        return "\n".join(f"--- {path.stem}\n{path.read_text()}" for path in sorted(self._folder.glob("*.log")))


def can_make_namespaces() -> bool:
    """Whether this machine and user can."""
    if os.geteuid() or shutil.which("ip") is None:
        return False
    name = f"uavlinkd-{os.getpid()}-try"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, check=False).returncode == 0
    subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)
    return made


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def namespaces(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Namespaces]:
    """Three drones and a ground station, for all tests of this file."""
    need(can_make_namespaces(), "root, and iproute2 with network namespaces")
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
    """The same, all linked."""
    await until(namespaces.are_all_linked, "all links are up")
    return namespaces


async def test_frames_reach_all_others_once(cluster: Namespaces) -> None:
    """What each vehicle's client says comes to each other's once, byte for byte."""
    await outages.check_frames(cluster)


@pytest.mark.parametrize("outage", outages.OUTAGES.values(), ids=outages.OUTAGES)
async def test_outage_ends_in_time_and_disturbs_no_other_link(
    cluster: Namespaces, outage: Callable[[Cluster], Awaitable[float]]
) -> None:
    """A host that was gone is linked again two seconds after it can be reached; the others lose no frame."""
    await outage(cluster)
