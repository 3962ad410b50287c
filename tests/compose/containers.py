"""Fleets in containers, by a real `docker compose up`."""

from __future__ import annotations

import os
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from tests.compose import images
from tests.compose.cluster import run, until
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.ops.control import ControlError, ask

USER = 10001
NETWORK = f"10.{64 + os.getpid() % 128}"
"""The first half of the addresses. Another checkout may test on the same machine."""
SUBNET = f"{NETWORK}.0.0/24"
LINKED_S = 5.0
"""From the last daemon's start until all links are up, on an idle machine."""
SYSTEM_IDS = {"drone1": 1, "drone2": 2, "drone3": 3, "ground-station": 255}

Status = dict[str, Any]


class Containers:
    """The services of compose.yaml."""

    def __init__(self, image: str) -> None:
        self.project = f"uavlinkd-test-{os.getpid()}"
        compose = images.compose_command()
        assert compose is not None
        self._compose = [*compose, "--project-name", self.project, "--file", str(images.CONTAINERS / "compose.yaml")]
        (self.page_port,) = free_ports(1)
        self.environ = {
            "UAVLINKD_IMAGE": image,
            "PAGE_PORT": str(self.page_port),
            "SUBNET": SUBNET,
            "RESTART": "no",
        }
        self._pids: dict[str, int] = {}
        self._logs = ""

    async def open(self) -> None:
        await self.compose("up", "--detach", "--no-build")
        for name in SYSTEM_IDS:
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

    def control_socket_of(self, name: str) -> Path:
        return Path(f"/proc/{self._pids[name]}/root/run/uavlinkd/control.sock")

    def logs(self) -> str:
        return self._logs

    def status(self, name: str) -> Status | None:
        """What the daemon says; None where it does not answer."""
        with suppress(ControlError, OSError, LookupError):
            return ask(self.control_socket_of(name), "status", timeout_s=1.0)
        return None

    def states(self, name: str) -> dict[str, str]:
        """How its peers are, as it says."""
        status = self.status(name)
        return {} if status is None else {peer: facts["state"] for peer, facts in status["peers"].items()}

    def are_all_linked(self) -> bool:
        return all(
            len(states) == len(SYSTEM_IDS) - 1 and set(states.values()) == {"up"}
            for states in map(self.states, SYSTEM_IDS)
        )

    async def until_linked(self) -> None:
        """Wait until all daemons listen, and see that all links are up in time from there.

        Raises:
            AssertionError: they are not.
        """
        starting = await until(lambda: all(map(self.status, SYSTEM_IDS)), "all daemons listen")
        took = await until(self.are_all_linked, "all links are up")
        print(f"all daemons listened after {starting:.2f} s, and all links were up {took:.2f} s later")
        assert took < LINKED_S


def health(container: str) -> str:
    command = ("docker", "inspect", "--format", "{{.State.Health.Status}}", container)
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


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
