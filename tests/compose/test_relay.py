"""Two drones and a ground station in containers that have only a relay in common."""

from __future__ import annotations

import tomllib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from tests.compose.cluster import Conversation, until
from tests.compose.containers import NETWORK, Containers, opened, replace
from tests.daemon.toml import to_toml
from uavlinkd.config import keys

pytestmark = [pytest.mark.asyncio(loop_scope="module"), pytest.mark.long]

MEMBERS = ("drone1", "drone2", "ground-station")
RELAY = "relay"
RETURNED_S = 2.0
"""From the start of the relay."""


class Relayed(Containers):
    """The services of compose.relay.yaml. Clients talk to the members."""

    file = "compose.relay.yaml"
    drones = 2
    names = MEMBERS

    def __init__(self, folder: Path, image: str) -> None:
        super().__init__(folder, image)
        names = ("FIRST", "SECOND", "THIRD")
        self.environ |= {name: f"{NETWORK}.{number}" for number, name in enumerate(names, 4)}

    def change(self, fleet: Path) -> None:
        """Each member has the address of the relay, and of no peer."""
        private_key = keys.generate_private_key()
        (fleet / RELAY).mkdir()
        keys.write_secret_file(fleet / RELAY / "relay.key", private_key)
        members = []
        for name in MEMBERS:
            file = fleet / name / f"{name}.toml"
            for other in MEMBERS:
                if other != name:
                    replace(file, f'"{other}:5790"', "")
            key = keys.public_key_text((fleet / name / f"{name}.key").read_text())
            members.append({"name": name, "public_key": key})
            relay = {
                "name": RELAY,
                "public_key": keys.public_key_text(private_key),
                "addresses": [f"{RELAY}:5790"],
            }
            file.write_text(file.read_text() + "\n" + to_toml({"relay": [relay]}))
            assert tomllib.loads(file.read_text())["relay"] == [relay]
        config = {
            "name": RELAY,
            "private_key_file": "relay.key",
            "listen": ["0.0.0.0:5790"],
            "control_socket": "/run/uavlinkd/control.sock",
            "member": members,
        }
        (fleet / RELAY / "relay.toml").write_text(to_toml(config))


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def cluster(image: str, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Relayed]:
    """All members are linked."""
    async with opened(Relayed(tmp_path_factory.mktemp("fleet"), image)) as cluster:
        yield cluster


async def test_members_reach_each_other_through_the_relay(cluster: Relayed) -> None:
    """Every frame of each arrives at both others once, and each path leads through the relay."""
    conversation = Conversation(cluster, MEMBERS)
    try:
        await conversation.open()
        await conversation.say_many(100)
        await conversation.check()
    finally:
        conversation.close()
    for name in MEMBERS:
        status = cluster.status(name)
        assert status is not None
        for peer in status["peers"].values():
            assert {path["relay"] for path in peer["paths"]} == {RELAY}


async def test_links_return_after_the_relay_was_killed(cluster: Relayed) -> None:
    """A relay that starts again has forgotten all; its members bind again, and frames pass."""
    await cluster.kill(RELAY)
    await until(lambda: not any("up" in cluster.states(name).values() for name in MEMBERS), "all links are lost")

    await cluster.start(RELAY)

    assert await until(cluster.are_all_linked, "all links are up again") < RETURNED_S
    conversation = Conversation(cluster, MEMBERS)
    try:
        await conversation.open()
        await conversation.say_many(20)
        await conversation.check()
    finally:
        conversation.close()
