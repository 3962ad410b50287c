"""The hostile relay does what its attacks say: members that are nodes of the core see it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from itertools import combinations

import pytest

from tests.relay.core_member import CoreMember
from uavlinkd.config.keys import decode_key
from uavlinkd.config.used_relays import TIMERS
from uavlinkd.core import constants as c
from uavlinkd.core.outputs import Deliver, Output
from uavlinkd.core.relay_records import handle_of
from uavlinkd.core.settings import Link
from uavlinkd.lab.evaluation.hostile_relay import HostileRelay

NAMES = ("drone0", "drone1", "drone2")
DATA = b"\x40datagram"


class Scene:
    """A hostile relay, and three members that are bound to each other."""

    def __init__(self) -> None:
        self.relay = HostileRelay(NAMES, None, 1)
        key = decode_key(str(self.relay.section["public_key"]))
        link = Link(features=c.FEATURE_RECORDS, timers=TIMERS)
        self.members = [CoreMember(key, ("127.0.0.1", self.relay.port), link=link) for _ in NAMES]

    async def start(self) -> None:
        """Return when all are bound."""
        keys = {name: member.key for name, member in zip(NAMES, self.members, strict=True)}
        await self.relay.start(dict.fromkeys(NAMES, 0), keys)
        await self.bind()

    async def bind(self) -> None:
        """All members ask for each other."""
        for member in self.members:
            await member.bind(*(other.key for other in self.members if other is not member))
        for one, other in combinations(self.members, 2):
            await one.until_bound(other.key)
            await other.until_bound(one.key)

    async def bind_again(self) -> None:
        """The relay has forgotten all members: they notice that nothing answers, and make new sessions."""
        made = [member.peer.traffic.handshakes for member in self.members]
        for member, count in zip(self.members, made, strict=True):
            member.bounds.clear()
            member.send_frames(DATA)
            await member.until(lambda m=member, n=count: m.peer.traffic.handshakes > n)  # type: ignore[misc]
        await self.bind()

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


async def test_without_an_attack_it_is_a_relay(scene: Scene) -> None:
    """It forwards, and reports what is true."""
    one, other, _ = scene.members
    one.send(one.handles(other.key)[0], DATA)
    await other.until(lambda: bool(other.data))
    assert other.data == [other.handles(one.key)[0].to_bytes(2, "big") + DATA]
    assert scene.seen_by(0) == {one.address}
    assert not (await scene.relay.statistics()).counts


async def test_forwarded_datagrams_pass_the_attacks_of_the_man_in_the_middle(scene: Scene) -> None:
    """Here a copy arrives at the third member, with a valid handle."""
    one, other, third = scene.members
    await scene.relay.attack(["misroute,kinds=any,direction=drone0>drone1"])
    one.send(one.handles(other.key)[0], DATA)
    await third.until(lambda: bool(third.data))
    assert third.data[0] == third.handles(one.key)[0].to_bytes(2, "big") + DATA
    assert (await scene.relay.statistics()).counts == {"misroute: misrouted": 1}


async def test_lies_about_addresses(scene: Scene) -> None:
    """Of a victim, which counts what it gets, and of groups."""
    await scene.relay.attack(["relay-lie"])
    await scene.members[0].until(lambda: len(scene.seen_by(0)) == 5)
    victim = scene.relay.victim.getsockname()
    assert scene.seen_by(0) >= {victim, ("224.0.0.1", 5790)}
    assert (await scene.relay.statistics()).bytes_to_strangers == 0
    scene.members[0].sock.sendto(DATA, victim)
    assert (await scene.relay.statistics()).bytes_to_strangers == len(DATA)


async def test_binds_wrong_members_and_reports_the_true_ones_at_the_end(scene: Scene) -> None:
    """The handle for one leads to another."""
    one, other, third = scene.members
    right = one.handles(other.key)
    await scene.relay.attack(["relay-bind-wrong"])
    await one.until(lambda: one.handles(third.key) == right)
    one.send(one.handles(third.key)[0], DATA)
    await other.until(lambda: bool(other.data))
    assert not third.data
    await scene.relay.attack([])
    await one.until(lambda: one.handles(other.key) == right)
    await third.until(lambda: bool(third.handles(one.key)))


async def test_invents_handles(scene: Scene) -> None:
    """And sends data inside data."""
    one, other, _ = scene.members
    one.send(one.handles(other.key)[0], DATA)
    await other.until(lambda: bool(other.data))
    await scene.relay.attack(["relay-invent"])
    await other.until(lambda: len(other.data) > 30)
    invented = {int.from_bytes(data[:2], "big") for data in other.data[1:]}
    assert len(invented) > 10
    assert any(handle_of(b"\x50" + data) == 0 for data in other.data), "nothing malformed"


async def test_sends_frames_of_its_own(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Members decide what to do with them: here, the core delivers them."""
    received: list[Output] = []
    member = scene.members[0]
    perform = member.perform

    def see(outputs: list[Output]) -> None:
        received.extend(outputs)
        perform(outputs)

    monkeypatch.setattr(member, "perform", see)
    await scene.relay.attack(["relay-frames"])
    await member.until(lambda: any(isinstance(output, Deliver) for output in received))


async def test_restarts_and_replays(scene: Scene) -> None:
    """What it recorded comes again along new handles."""
    one, other, _ = scene.members
    one.send(one.handles(other.key)[0], DATA)
    await other.until(lambda: bool(other.data))
    other.data.clear()
    await scene.relay.attack(["relay-restart"])
    assert scene.relay.attack_object is not None
    scene.relay.attack_object.every_s = 1e9
    await scene.bind_again()
    await other.until(lambda: bool(other.data))
    assert other.data[0][2:] == DATA
    assert (await scene.relay.statistics()).counts["relay-restart: replayed"] >= 1
