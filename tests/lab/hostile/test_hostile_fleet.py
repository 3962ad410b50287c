"""A hostile relay of a fleet with an authority, between real daemons."""

from __future__ import annotations

import asyncio
from base64 import b64decode
from collections.abc import AsyncIterator
from dataclasses import replace

import pytest

from tests.authority.signing import AUTHORITY
from tests.daemon.harness import Stage
from tests.daemon.members import CertifiedFleet
from tests.daemon.process import Status
from tests.lab.hostile.test_hostile_relay import AMPLE, LINK, settings_of
from uavlinkd.core import constants as c
from uavlinkd.core.certificates import MemberRole
from uavlinkd.core.crypto import Secret
from uavlinkd.lab.hostile.hostile_fleet import HostileMembership
from uavlinkd.lab.hostile.hostile_relay import HostileRelay
from uavlinkd.system.addresses import Address


def is_up(status: Status, *names: str) -> bool:
    return all(status["peers"].get(name, {}).get("state") == "up" for name in names)


class FleetScene:
    """Three vehicles that know a hostile relay alone, and call each other."""

    def __init__(self, stage: Stage) -> None:
        self.fleet = CertifiedFleet()
        relay = stage.daemon("relay")
        self.fleet.join(relay, MemberRole.RELAY)
        self.members = [stage.daemon(f"v{number}", []) for number in (1, 2, 3)]
        for number, member in enumerate(self.members, 1):
            self.fleet.join(member, MemberRole.VEHICLE, number, relay)
            member.config["fleet"]["call"] = ["vehicle"]
        membership = HostileMembership(
            authority=AUTHORITY,
            certificate=self.fleet.certificates["relay"][1],
            bulletin=self.fleet.bulletin,
            link=replace(LINK, features=c.FEATURE_RECORDS | c.FEATURE_FLEET),
            limits=AMPLE,
            most_peers=16,
        )
        host, port = relay.address.rsplit(":", 1)
        private = Secret(b64decode(relay.private_key))
        listen = (Address(host, int(port)),)
        self.relay = HostileRelay(settings_of({}, private_key=private, listen=listen, fleet=membership))

    async def start(self, stage: Stage) -> None:
        await self.relay.start()
        await stage.start(*self.members, linked=False)
        await self.linked()

    async def linked(self) -> None:
        names = {member.name for member in self.members}
        for member in self.members:
            await member.until(lambda status, one=member.name: is_up(status, *names - {one}))  # type: ignore[misc]


@pytest.fixture
async def scene() -> AsyncIterator[FleetScene]:
    """All members have links with each other."""
    async with Stage() as stage:
        scene = FleetScene(stage)
        try:
            await scene.start(stage)
            yield scene
        finally:
            await scene.relay.stop()


async def test_members_pass_on_a_bulletin_that_the_relay_withholds(scene: FleetScene) -> None:
    """The relay cannot look into their sessions. It can hide a member only from one that does not know it."""
    one, two, three = scene.members
    scene.relay.attack(["relay-withhold"])
    await one.ask(scene.fleet.revoke("v3"))
    await two.until(lambda status: status["fleet"]["number"] == 2 and "v3" not in status["peers"])
    await asyncio.gather(two.stop(), three.stop())
    await two.start()
    await two.until(lambda status: scene.relay.statistics()["interventions"] != {})
    assert not is_up(await two.ready(), "v1")
    scene.relay.attack([])
    await two.until(lambda status: is_up(status, "v1"))


async def test_false_certificates_change_nothing(scene: FleetScene) -> None:
    """With another member's key, or altered: each is refused, and the links stay."""
    held = [(await member.status())["fleet"]["held"] for member in scene.members]
    scene.relay.attack(["relay-introduce,lie=key", "relay-introduce,lie=bytes"])
    for member in scene.members:
        await member.until(lambda status: status["drops"].get("bad_certificate", 0) > 20)
    await scene.linked()
    assert [(await member.status())["fleet"]["held"] for member in scene.members] == held
