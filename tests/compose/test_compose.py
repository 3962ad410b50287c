"""A fleet in containers, by a real `docker compose up` of compose.yaml: links, frames, confinement."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from urllib.request import urlopen

import pytest
import pytest_asyncio

from tests.compose.cluster import run, until
from tests.compose.containers import SYSTEM_IDS, USER, Containers, health, opened

pytestmark = pytest.mark.asyncio(loop_scope="module")


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def cluster(image: str) -> AsyncIterator[Containers]:
    """Three drones and a ground station, for all tests of this file."""
    async with opened(Containers(image)) as opened_cluster:
        yield opened_cluster


async def test_autopilots_fly(cluster: Containers) -> None:
    """All daemons are linked, and frames of each vehicle's autopilot keep arriving."""

    def from_endpoint(name: str) -> int:
        status = cluster.status(name)
        assert status is not None
        (endpoint,) = status["endpoints"].values()
        return int(endpoint["frames_received"])

    for name in ("drone1", "drone2", "drone3"):
        before = from_endpoint(name)
        await until(lambda name=name, before=before: from_endpoint(name) > before, f"{name}'s autopilot flies")  # type: ignore[misc]


def read(url: str) -> str:
    """The text at an address of this machine."""
    with urlopen(url) as answer:
        return str(answer.read().decode())


async def test_page_is_on_the_loopback_of_the_host(cluster: Containers) -> None:
    """It shows the ground station, by a process without its key."""
    page = await cluster.container("page")
    await until(lambda: health(page) == "healthy", "the page is there")
    assert 'peer="drone3"' in await asyncio.to_thread(read, f"http://127.0.0.1:{cluster.page_port}/metrics")
    assert (await run("docker", "exec", page, "ls", "/etc/uavlinkd", check=False)).count("No such file") == 1


async def test_containers_are_healthy_confined_and_unprivileged(cluster: Containers) -> None:
    """A station without a client too. The daemon is not root, and writes nothing but its state."""
    for name in SYSTEM_IDS:
        container = await cluster.container(name)
        await until(lambda container=container: health(container) == "healthy", f"{name} is healthy")  # type: ignore[misc]
        assert f"{name}.fleet-state" in await run("docker", "exec", container, "ls", "/var/lib/uavlinkd")
    drone = await cluster.container("drone1")
    assert "fleet_state_degraded" not in await cluster.compose("logs", "--no-color")
    assert (await run("docker", "exec", drone, "id", "-u")).strip() == str(USER)
    for path in ("/x", "/tmp/x", "/etc/uavlinkd/x", "/opt/uavlinkd/x"):
        assert "Read-only file system" in await run("docker", "exec", drone, "touch", path, check=False)
    capabilities = await run("docker", "exec", drone, "grep", "CapEff", "/proc/1/status")
    assert int(capabilities.split()[1], 16) == 0
