"""Fleets in containers, by a real `docker compose up`."""

from __future__ import annotations

import os
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from tests.compose import images
from tests.compose.cluster import SYSTEM_IDS, Cluster, run
from tests.fleet.vehicles import create
from uavlinkd.fleet.manifest import FleetSettings
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.system.addresses import Address

USER = 10001
NETWORK = f"10.{64 + os.getpid() % 128}"
"""The first half of the addresses. Another checkout may test on the same machine."""
SUBNET, MITM_SUBNET = f"{NETWORK}.0.0/24", f"{NETWORK}.1.0/24"


class Containers(Cluster):
    """The services of compose.yaml."""

    def __init__(self, folder: Path, image: str, *, mitm: bool = False) -> None:
        self._folder = folder
        self.project = f"uavlinkd-test-{os.getpid()}{'-mitm' if mitm else ''}"
        self._mitm = mitm
        compose = images.compose_command()
        assert compose is not None
        self._compose = [*compose, "--project-name", self.project, "--file", str(images.HERE / "compose.yaml")]
        if mitm:
            self._compose += ["--profile", "mitm"]
        self.environ = {
            "UAVLINKD_IMAGE": image,
            "FLEET": str(folder / "fleet"),
            "SUBNET": MITM_SUBNET if mitm else SUBNET,
            "RESTART": "no",
        }
        self._pids: dict[str, int] = {}
        self._logs = ""

    async def open(self) -> None:
        settings = FleetSettings(
            swarm=True, control_socket="/run/uavlinkd/control.sock", ground_station_url="udpin:127.0.0.1:14550"
        )
        fleet = self._folder / "fleet"
        create(fleet, settings, drones=3, stations=1, at=[Address("ground-station", 5790)])
        if self._mitm:
            replace(fleet / "drone1" / "drone1.toml", '"ground-station:5790"', '"mitm:5801"')
            replace(fleet / "drone1" / "drone1.toml", "listen = []", 'listen = ["0.0.0.0:5790"]')
        for path in (fleet, *fleet.rglob("*")):
            os.chown(path, USER, USER)
        for path in (fleet, *fleet.parents):
            if path == self._folder.parent:
                break
            path.chmod(0o755)
        await self.compose("up", "--detach", "--no-build")
        for name in (*SYSTEM_IDS, *(("mitm",) if self._mitm else ())):
            pid = await run("docker", "inspect", "--format", "{{.State.Pid}}", await self.container(name))
            self._pids[name] = int(pid)

    async def close(self) -> None:
        """Stop and remove everything but the image."""
        self._logs = await self.compose("logs", "--no-color", check=False)
        await self.compose("down", "--volumes", "--timeout", "1", check=False)

    async def compose(self, *arguments: str, check: bool = True) -> str:
        return await run(*self._compose, *arguments, environ=self.environ, check=check)

    async def container(self, service: str) -> str:
        """The container's id, running or not."""
        filters = (f"com.docker.compose.project={self.project}", f"com.docker.compose.service={service}")
        containers = await run("docker", "ps", "-aq", *(f"--filter=label={label}" for label in filters))
        assert len(containers.split()) == 1, f"{service} has the containers: {containers}"
        return containers.strip()

    def namespace_of(self, name: str) -> Path:
        return Path(f"/proc/{self._pids[name]}/ns/net")

    def control_socket_of(self, name: str) -> Path:
        return Path(f"/proc/{self._pids[name]}/root/run/uavlinkd/control.sock")

    def logs(self) -> str:
        return self._logs

    # The man in the middle.

    def ask_mitm(self, request: str) -> dict[str, Any]:
        """What the man in the middle answers; nothing where he is not there."""
        try:
            return ask(Path(f"/proc/{self._pids['mitm']}/root/run/uavlinkd/mitm.sock"), request)
        except ControlError:
            return {}

    def interventions(self, attack: str) -> int:
        counts: dict[str, int] = self.ask_mitm("statistics").get("interventions", {})
        return sum(count for name, count in counts.items() if name.partition(":")[0] == attack)


def health(container: str) -> str:
    command = ("docker", "inspect", "--format", "{{.State.Health.Status}}", container)
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def replace(path: Path, old: str, new: str) -> None:
    """Replace the only occurrence of a text in a file."""
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))


@asynccontextmanager
async def opened(cluster: Containers) -> AsyncIterator[Containers]:
    """A cluster from `up` to `down`."""
    try:
        await cluster.open()
        await cluster.until_linked()
        yield cluster
    finally:
        await cluster.close()
        print(cluster.logs())
