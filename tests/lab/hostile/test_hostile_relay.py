"""The hostile relay does what its attacks say: members that are nodes of the core see it."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from itertools import combinations

import pytest

from tests.relay.core_member import CoreMember
from uavlinkd.config.build import TIMERS
from uavlinkd.config.model import RelayServer
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.lab.hostile.all_attacks import ALL_ATTACKS
from uavlinkd.lab.hostile.hostile_relay import HostileRelay, HostileRelaySettings
from uavlinkd.lab.hostile.relay_attacks import REPLAY_EVERY_S
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.relay.forwarding import MemberSettings, RelayLimits
from uavlinkd.system.addresses import Address

NAMES = ("drone0", "drone1", "drone2")
DATA = b"\x40datagram"
TOKEN, OTHER_TOKEN = bytes(16), bytes(range(16))
ANY = Address("127.0.0.1", 0)
AMPLE = RelayLimits(1_000_000, 10**10)
LINK = Link(features=c.FEATURE_RECORDS, timers=TIMERS)


def settings_of(keys: dict[str, bytes], *attacks: str, **more: object) -> HostileRelaySettings:
    """A relay with these members on a free port of loopback."""
    members = (PeerSettings(name, key, None, Link(features=c.FEATURE_RECORDS)) for name, key in keys.items())
    known: dict[str, object] = {
        "name": "vps",
        "private_key": Secret(os.urandom(c.KEY_BYTES)),
        "listen": (ANY,),
        "server": RelayServer(tuple(MemberSettings(member, 16, AMPLE) for member in members), AMPLE),
        "attacks": tuple(parse_attack(text, ALL_ATTACKS) for text in attacks),
        "seed": 1,
    }
    return HostileRelaySettings(**{**known, **more})  # type: ignore[arg-type]


class Scene:
    """A hostile relay, and three members that are bound to each other."""

    def __init__(self) -> None:
        private = os.urandom(c.KEY_BYTES)
        port = free_port()
        at = ("127.0.0.1", port)
        self.members = [CoreMember(KeyPair(private).public, at, link=LINK) for _ in NAMES]
        keys = {name: member.key for name, member in zip(NAMES, self.members, strict=True)}
        self.relay = HostileRelay(settings_of(keys, private_key=Secret(private), listen=(Address(*at),)))

    async def start(self) -> None:
        await self.relay.start()
        await self.bind()

    @property
    def interventions(self) -> dict[str, int]:
        counts = self.relay.statistics()["interventions"]
        assert isinstance(counts, dict)
        return counts

    async def bind(self) -> None:
        """All members ask for each other."""
        for member in self.members:
            await member.bind(*(other.key for other in self.members if other is not member))
        for one, other in combinations(self.members, 2):
            await one.until_bound(other.key)
            await other.until_bound(one.key)

    async def connect_again(self) -> None:
        """The relay has forgotten all members: they notice that nothing answers, and make new sessions."""
        await self.members[0].until(lambda: not self.relay.statistics()["members_up"])
        made = [member.peer.traffic.handshakes for member in self.members]
        for member, count in zip(self.members, made, strict=True):
            member.bounds.clear()
            member.send_frames(DATA)
            await member.until(lambda m=member, n=count: m.peer.traffic.handshakes > n)  # type: ignore[misc]

    def seen_by(self, number: int) -> set[tuple[str, int]]:
        """The addresses that the relay reported to a member as its own."""
        return {(bound.host, bound.port) for bound in self.members[number].bounds}


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    """Ends its parts after the test."""
    scene = Scene()
    try:
        await scene.start()
        yield scene
    finally:
        for member in scene.members:
            member.close()
        await scene.relay.stop()


async def test_forwarded_datagrams_pass_the_attacks_of_the_man_in_the_middle(scene: Scene) -> None:
    """Here a copy arrives at the third member, with a valid handle."""
    one, other, third = scene.members
    scene.relay.attack(["misroute,kinds=any,direction=drone0>drone1"])
    one.send(one.handles(other.key)[0], DATA)
    await third.until(lambda: bool(third.data))
    assert third.data[0] == third.handles(one.key)[0].to_bytes(2, "big") + DATA
    assert scene.interventions == {"misroute: misrouted": 1}


async def test_lies_about_addresses(scene: Scene) -> None:
    """Of a victim, which counts what it gets, and of groups."""
    scene.relay.attack(["relay-lie"])
    await scene.members[0].until(lambda: len(scene.seen_by(0)) == 5)
    victim = scene.relay.victim
    assert scene.seen_by(0) >= {victim, ("224.0.0.1", 5790)}
    assert scene.relay.statistics()["strangers"] == {"bytes_back": 0, "amplified": {}}
    scene.members[0].sock.sendto(DATA, victim)
    assert scene.relay.statistics()["strangers"] == {"bytes_back": len(DATA), "amplified": {}}


async def test_binds_wrong_members_and_reports_the_true_ones_at_the_end(scene: Scene) -> None:
    """The handle for one leads to another."""
    one, other, third = scene.members
    right = one.handles(other.key)
    scene.relay.attack(["relay-bind-wrong"])
    await one.until(lambda: one.handles(third.key) == right)
    one.send(one.handles(third.key)[0], DATA)
    await other.until(lambda: bool(other.data))
    assert not third.data
    scene.relay.attack([])
    await one.until(lambda: one.handles(other.key) == right)
    await third.until(lambda: bool(third.handles(one.key)))


async def test_lies_about_filters(scene: Scene) -> None:
    """It says that it sent a token from another port. Others come that the member did not ask for."""
    one = scene.members[0]
    await one.test_filter(TOKEN)
    await one.until(lambda: one.tested == [TOKEN] and bool(one.tokens))
    ((token, source),) = one.tokens
    assert token == TOKEN
    assert source != one.path.address
    scene.relay.attack(["relay-filter"])
    await one.test_filter(OTHER_TOKEN)
    await one.until(lambda: (OTHER_TOKEN, one.path.address) in one.tokens and OTHER_TOKEN in one.tested)
    await one.until(lambda: len(one.tokens) > 5)
    assert {source for _, source in one.tokens[1:]} == {one.path.address}
    assert scene.interventions["relay-filter: injected"] > 1


async def test_restarts_and_replays(scene: Scene) -> None:
    """What it recorded comes again along new handles, also if other members have theirs before."""
    one, other, third = scene.members
    scene.relay.attack(["relay-restart,limit=1,rate_per_s=10"])
    one.send(one.handles(other.key)[0], DATA)
    await scene.connect_again()
    await one.bind(third.key)
    await third.bind(one.key)
    await third.until_bound(one.key)
    await asyncio.sleep(3 * REPLAY_EVERY_S)
    await scene.bind()
    await other.until(lambda: len(other.data) == 2)
    assert other.data[1] == other.handles(one.key)[0].to_bytes(2, "big") + DATA
    assert scene.interventions == {"relay-restart: replayed": 1}
