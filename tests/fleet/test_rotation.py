"""Rotations of keys while the fleet flies. `test_relays` has one along a relay."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator
from itertools import permutations
from pathlib import Path

import pytest

from tests.fleet.vehicles import NAMES, Vehicles, flying
from tests.waiting import until
from uavlinkd.config import keys
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import FleetSettings, MemberKind, read_manifest
from uavlinkd.fleet.transaction import check_members

pytestmark = pytest.mark.long


@pytest.fixture
async def vehicles() -> AsyncIterator[Vehicles]:
    """Three linked drones."""
    async with flying() as vehicles:
        yield vehicles


async def test_old_key_is_refused_after_a_rotation(vehicles: Vehicles) -> None:
    """A copy of the old files is an unknown peer to daemons that have the new key."""
    stolen = vehicles.fleet.parent / "stolen"
    shutil.copytree(vehicles.place("drone1"), stolen, ignore=shutil.ignore_patterns("*.sock"))
    operations.rotate(vehicles.fleet, "drone1")
    for name in NAMES:
        await vehicles.renew(name, restart=name == "drone1")
    await vehicles.until_linked()

    await vehicles.stop("drone1")
    shutil.rmtree(vehicles.place("drone1"))
    shutil.copytree(stolen, vehicles.place("drone1"))
    before = {name: strangers(vehicles, name) for name in ("drone2", "drone3")}
    await vehicles.start("drone1")
    await until(lambda: all(strangers(vehicles, name) > count for name, count in before.items()))
    for name in before:
        assert vehicles.peers(name)["drone1"]["state"] != "up"


def strangers(vehicles: Vehicles, name: str) -> int:
    """The number of handshakes with unknown keys that a daemon dropped."""
    drops: dict[str, int] = vehicles.status(name).get("drops", {})
    return drops.get("unknown_peer", 0)


def test_files_load_after_every_command(tmp_path: Path) -> None:
    """A daemon accepts its file after the commands in every order."""
    for number, order in enumerate(permutations(("rotate", "add", "remove"))):
        fleet = tmp_path / str(number)
        operations.init(fleet, FleetSettings(psk=True), 3, 1, 0)
        for action in order:
            if action == "rotate":
                operations.rotate(fleet, "drone1")
            elif action == "add":
                operations.add(fleet, "scout", MemberKind.DRONE)
            elif action == "remove":
                operations.remove(fleet, "drone2")
        check_members(fleet, read_manifest(fleet).members)
        key = (fleet / "drone1" / "drone1.key").read_text()
        assert keys.public_key_text(key) == read_manifest(fleet).member("drone1").public_key
