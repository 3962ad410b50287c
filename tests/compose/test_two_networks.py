"""A drone with two networks, in containers: `docker network disconnect` and connect again, under traffic."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from tests.compose.cluster import Conversation, heartbeat, run, until
from tests.compose.containers import NETWORK, Containers, opened, replace

pytestmark = [pytest.mark.asyncio(loop_scope="module"), pytest.mark.long]

LTE, MESH = f"{NETWORK}.2", f"{NETWORK}.3"
DRONE, GROUND = "drone1", "ground-station"


class TwoNetworks(Containers):
    """The services of compose.two-networks.yaml."""

    file = "compose.two-networks.yaml"
    drones = 1
    names = (DRONE, GROUND)

    def __init__(self, folder: Path, image: str) -> None:
        super().__init__(folder, image)
        self.environ |= {"LTE": LTE, "MESH": MESH}

    def change(self, fleet: Path) -> None:
        """Both addresses of the ground station for the drone; the ground station learns those of the drone."""
        replace(fleet / DRONE / f"{DRONE}.toml", '"ground-station:5790"', f'"{LTE}.9:5790", "{MESH}.9:5790"')
        replace(fleet / GROUND / f"{GROUND}.toml", '"drone1:5790"', "")

    async def disconnect(self, network: str) -> None:
        """Take the drone's interface of a network away."""
        await run("docker", "network", "disconnect", f"{self.project}_{network}", await self.container(DRONE))

    async def connect(self, network: str, address: str) -> None:
        """Give it another one."""
        await run(
            *("docker", "network", "connect", "--ip", address),
            *(f"{self.project}_{network}", await self.container(DRONE)),
        )

    def usable(self, name: str, peer: str) -> set[str]:
        """The network parts of the remote addresses of a daemon's usable paths."""
        status = self.status(name)
        paths = [] if status is None else status["peers"][peer]["paths"]
        return {path["address"].rpartition(".")[0] for path in paths if path["state"] == "usable"}


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def cluster(image: str, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[TwoNetworks]:
    """A drone and a ground station, both paths of which are usable at both ends."""
    async with opened(TwoNetworks(tmp_path_factory.mktemp("fleet"), image)) as cluster:
        await _until_both(cluster)
        yield cluster


async def _until_both(cluster: TwoNetworks) -> None:
    for name, peer in ((DRONE, GROUND), (GROUND, DRONE)):
        await until(
            lambda name=name, peer=peer: cluster.usable(name, peer) >= {LTE, MESH},  # type: ignore[misc]
            f"both paths of {name} are usable",
        )


@pytest.mark.parametrize(("network", "prefix"), [("lte", LTE), ("mesh", MESH)], ids=["lte", "mesh"])
async def test_no_heartbeat_is_lost_while_a_network_goes_and_returns(
    cluster: TwoNetworks, network: str, prefix: str
) -> None:
    """Every HEARTBEAT in both directions arrives once while one of two networks disappears and returns."""

    async def interruption() -> None:
        await cluster.disconnect(network)
        for name, peer in ((DRONE, GROUND), (GROUND, DRONE)):
            await until(
                lambda name=name, peer=peer: prefix not in cluster.usable(name, peer),  # type: ignore[misc]
                f"{name} noticed that a path is gone",
            )
        await cluster.connect(network, f"{prefix}.2")
        await _until_both(cluster)

    conversation = Conversation(cluster, cluster.names, heartbeat)
    try:
        await conversation.open()
        await conversation.during(interruption())
        await conversation.check()
    finally:
        conversation.close()
