"""A captured station passes what a captured peer with its role passes: of each message and command, also forged."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from tests.processes.frames import command_long, heartbeat, sender_of
from tests.processes.harness import Stage
from tests.processes.udp import Client
from tests.samples import build
from tests.stations.test_daemon import Setup
from uavlinkd.mavlink.dialect import COMMANDS, IDS, MESSAGES

pytestmark = pytest.mark.long
OWN, FOREIGN = 255, (1, 7)
REQUEST = build(IDS["PARAM_REQUEST_READ"], bytes(20), OWN)
"""Every role may send it, and it must be new."""
AT_ONCE = 20
ROUNDS = 3


def attempts(system: int) -> list[bytes]:
    """A frame of each message, one for each command, and a heartbeat in MAVLink 1."""
    messages = [build(msgid, bytes(facts[2]), system) for msgid, facts in MESSAGES.items()]
    commands = [command_long(number, system, (0, 0)) for number in COMMANDS.values()]
    return [*messages, *commands, heartbeat(system, version=1)]


def kind(frame: bytes) -> tuple[int, int, int]:
    """The sender of a frame, its message, and its command if it is one."""
    msgid = int.from_bytes(frame[7:10], "little") if frame[0] == 0xFD else 1 << 24 | frame[5]
    is_command = msgid == 76 and frame[1] >= 30
    return sender_of(frame), msgid, int.from_bytes(frame[38:40], "little") if is_command else 0


async def table(
    autopilot: Client, send: Callable[[bytes], None], keep: Callable[[], None]
) -> set[tuple[int, int, int]]:
    """What arrives at the autopilot of all that a source can try."""
    passed: set[tuple[int, int, int]] = set()
    for _ in range(ROUNDS):
        for system in (OWN, *FOREIGN):
            frames = attempts(system)
            for start in range(0, len(frames), AT_ONCE):
                keep()
                for frame in frames[start : start + AT_ONCE]:
                    send(frame)
                await asyncio.sleep(0.02)
        passed |= {kind(frame) for frame in autopilot.frames}
        autopilot.clear()
    return passed


async def of_station(role: str) -> set[tuple[int, int, int]]:
    """The table of a station."""
    async with Stage() as stage:
        setup = Setup(stage, await stage.client())
        setup.daemon.config["station"][0]["role"] = role
        await setup.connect(REQUEST)
        client, tablet = setup.tablet.client, setup.tablet
        try:
            return await table(
                setup.autopilot,
                lambda frame: tablet.send(client.udp(frame)),
                lambda: setup.autopilot.send(heartbeat(), setup.to_autopilot),
            )
        finally:
            tablet.close()


async def of_peer(role: str) -> set[tuple[int, int, int]]:
    """The table of a peer, whose own daemon refuses nothing."""
    async with Stage() as stage:
        drone, ground, psk = stage.daemon("drone1"), stage.daemon("ground"), stage.psk()
        drone.add_peer(ground, [ground.address], psk, role=role, system_ids=[OWN])
        ground.add_peer(drone, [drone.address], psk, role="all", system_ids="all")
        autopilot, software = await stage.client(), await stage.client()
        to_autopilot = drone.add_endpoint("autopilot", system_ids=[1])
        to_ground = ground.add_endpoint("software")
        await stage.start(drone, ground)
        while not autopilot.frames:
            autopilot.send(heartbeat(), to_autopilot)
            software.send(REQUEST, to_ground)
            await asyncio.sleep(0.05)
        return await table(
            autopilot,
            lambda frame: software.send(frame, to_ground),
            lambda: autopilot.send(heartbeat(), to_autopilot),
        )


@pytest.mark.parametrize("role", ["operator", "observer"])
async def test_same_table_as_a_captured_peer(role: str) -> None:
    """Both daemons run, so what is compared is what arrives."""
    station, peer = await of_station(role), await of_peer(role)
    print(f"{role}: {len(peer)} of {3 * len(attempts(OWN))} kinds pass of a peer, {len(station)} of a station")
    assert {sender for sender, _, _ in station} <= {OWN}
    assert station == peer
