"""Changes of members while the fleet flies: its daemons meet at a relay, and hear of each change from there."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator

import pytest

from tests.fleet.vehicles import NAMES, RELAY, Vehicles, flying, join, unasked
from tests.waiting import until
from uavlinkd.fleet import operations
from uavlinkd.lab.sim.loopback_ports import free_port

pytestmark = pytest.mark.long


@pytest.fixture
async def vehicles() -> AsyncIterator[Vehicles]:
    """Three drones that are linked with each other, and their relay."""
    async with flying() as vehicles:
        yield vehicles


async def published(vehicles: Vehicles, name: str = RELAY) -> None:
    """Hand the bulletin to one daemon only."""
    socket = vehicles.place(name) / f"{name}.sock"
    await asyncio.to_thread(operations.publish, vehicles.fleet, socket, unasked)


async def test_revoked_member_is_cut_off(vehicles: Vehicles) -> None:
    """By all, without a change of their files, also if one of them got the bulletin, and after a restart of both."""
    operations.revoke(vehicles.fleet, "drone2", unasked)
    await published(vehicles, "drone1")
    await until(lambda: all("drone2" not in vehicles.up(name) for name in ("drone1", "drone3", RELAY)))
    refused = vehicles.drops(RELAY)
    for name in ("drone1", "drone2"):
        await vehicles.stop(name)
        await vehicles.start(name)
    await until(lambda: vehicles.up("drone1") == {"drone3"})
    await until(lambda: vehicles.drops(RELAY) > refused)
    assert "drone2" not in vehicles.up("drone1") | vehicles.up("drone3") | vehicles.up(RELAY)


async def test_key_is_replaced(vehicles: Vehicles) -> None:
    """The member that has the new key is linked; the files of others stay as they are."""
    join(vehicles.fleet, "drone1", replaces=True)
    await published(vehicles)
    vehicles.carry("drone1")
    await vehicles.stop("drone1")
    await vehicles.start("drone1")
    await vehicles.until_linked()


async def test_enrolled_member_joins(vehicles: Vehicles) -> None:
    """By the two lines, piped as over ssh. No other file changes and no daemon is reloaded."""
    place = vehicles.place("scout")
    place.mkdir()
    uavlinkd = f"{sys.executable} -m uavlinkd"
    finish = f"{uavlinkd} enroll --finish --url udpin:127.0.0.1:{free_port()}"
    sign = f"{uavlinkd} fleet sign --out {vehicles.fleet}"
    pipe = await asyncio.create_subprocess_shell(f"{uavlinkd} enroll scout | {sign} | {finish}", cwd=place)
    assert await pipe.wait() == 0
    await vehicles.start("scout")
    await until(lambda: all("scout" in vehicles.up(name) for name in (*NAMES, RELAY)))
