"""A fleet in containers, by a real `docker compose up` of compose.yaml: links, confinement, a man in the middle."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from tests.compose.cluster import SYSTEM_IDS, Conversation, check_frames, run, until
from tests.compose.containers import USER, Containers, health, opened

pytestmark = pytest.mark.asyncio(loop_scope="module")


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def cluster(image: str, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Containers]:
    """Three drones and a ground station, for all tests of this file."""
    async with opened(Containers(tmp_path_factory.mktemp("fleet"), image)) as opened_cluster:
        yield opened_cluster


async def test_frames_reach_all_others_once(cluster: Containers) -> None:
    """What each vehicle's client says comes to each other's once, byte for byte; the autopilots beside them fly."""
    await check_frames(cluster)

    def from_endpoint(name: str) -> int:
        status = cluster.status(name)
        assert status is not None
        (endpoint,) = status["endpoints"].values()
        return int(endpoint["frames_received"])

    for name in ("drone1", "drone2", "drone3"):
        before = from_endpoint(name)
        await until(lambda name=name, before=before: from_endpoint(name) > before, f"{name}'s autopilot flies")  # type: ignore[misc]


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


ATTACKS = ("bit-flip,share=0.2", "replay-data")
"""On the data of a link that is up. `evaluate tampering` makes all attacks."""


async def test_man_in_the_middle_gets_nothing_accepted(image: str, tmp_path: Path) -> None:
    """Through a set of attacks between drone1 and the ground station, every frame arrives at most once and unaltered.

    Then it passes everything, and everything arrives.
    """
    async with opened(Containers(tmp_path, image, mitm=True)) as cluster:
        conversation = Conversation(cluster, ("drone1", "ground-station"))
        try:
            await conversation.open()
            for attack in ATTACKS:
                await _attack(cluster, conversation, attack)
            cluster.ask_mitm("attack none")
            await until(cluster.are_all_linked, "all links are up")
            conversation.forget()
            await conversation.say_many(200)
            await conversation.check()
        finally:
            conversation.close()
        for name in ("drone1", "ground-station"):
            status = cluster.status(name)
            assert status is not None
            assert sum(status["drops"].values()) + sum(sum(p["drops"].values()) for p in status["peers"].values())


async def _attack(cluster: Containers, conversation: Conversation, attack: str) -> None:
    name = attack.partition(",")[0]
    assert cluster.ask_mitm(f"attack {attack}"), f"{name} is not an attack"
    before = conversation.said

    def has_intervened() -> bool:
        conversation.say()
        return cluster.interventions(name) >= 20

    await until(has_intervened, f"{name} intervened")
    conversation.check_nothing_else()
    print(f"{name}: {cluster.interventions(name)} interventions in {conversation.said - before} frames of each")
