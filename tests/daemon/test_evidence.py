"""The evidence and the counters behind findings: what they count for, when they expire, and their bounds."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import pytest

from tests.policies import TRUSTED
from tests.processes.frames import heartbeat
from tests.protocol.harness import PLAIN
from uavlinkd.config.model import PeerAddress, PeerConfig
from uavlinkd.daemon.evidence import (
    ELSEWHERE,
    EVIDENCE_S,
    MAX_DETAILS,
    PLACES_S,
    REPORTED,
    Evidence,
)
from uavlinkd.daemon.peer_link import Carriage, PeerLink
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.observe.history import REMEMBERED_S, History, RecentGrowth
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Dropped
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.system.addresses import Address

HOST = "192.0.2.2"
THERE = (HOST, 5790)
OWN_KEY = bytes([7]) * 32


class Scene:
    """One peer, configured at :data:`THERE`, and the evidence about it."""

    def __init__(self) -> None:
        self.links: dict[str, PeerLink] = {}
        self.evidence = Evidence(self.links, OWN_KEY)
        self.node = Node(Secret(bytes([1]) * 32), os.urandom, 0.0)
        self.link = self.add("drone1", bytes([2]) * 32, [THERE])

    def add(self, name: str, key: bytes, addresses: list[tuple[str, int]]) -> PeerLink:
        """Another peer, at these addresses."""
        written = tuple(PeerAddress(Address(*address)) for address in addresses)
        config = PeerConfig(PeerSettings(name, key, None, PLAIN), written, TRUSTED)
        peer = self.node.add_peer(config.settings, 0.0)
        link = self.links[name] = PeerLink(config, peer, Carriage(self.node, lambda _: None), 0.0)
        link.set_paths([Path(0, address) for address in addresses], 0.0)
        return link

    def drop(self, address: tuple[str, int], now: float, detail: bytes | str = b"key") -> None:
        """An initiation by an unknown key came from there."""
        self.evidence.add_dropped(Dropped(DropReason.UNKNOWN_PEER, None, Path(0, address), 1, detail), now)

    def seen(self, link: PeerLink, now: float) -> Any:
        """What counts for a peer."""
        return self.evidence.seen(DropReason.UNKNOWN_PEER, link, now)


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.mark.parametrize("address", [THERE, (HOST, 40000)], ids=["its address", "another port of its host"])
def test_evidence_from_the_host_of_a_peer_counts_until_it_expires(scene: Scene, address: tuple[str, int]) -> None:
    """Other ports count too: a router or a restart changes them."""
    scene.drop(address, 10.0)
    assert scene.seen(scene.link, 10.0 + EVIDENCE_S).address == address
    assert scene.seen(scene.link, 10.1 + EVIDENCE_S) is None
    scene.drop(address, 100.0, b"other")
    assert list(scene.seen(scene.link, 100.0).details) == [b"other"]
    assert scene.seen(scene.link, 100.0).count == 1


def test_evidence_of_a_relay_counts_for_no_peer_of_that_name(scene: Scene) -> None:
    """Its name in the core begins with "relay". It is not forgotten when the places of the peers are looked up."""
    link = scene.add("relay", bytes([3]) * 32, [])
    relay = scene.node.add_peer(PeerSettings("relay vps", bytes([4]) * 32, None, PLAIN), 0.0)
    scene.evidence.add_dropped(Dropped(DropReason.BAD_HANDSHAKE, relay, Path(0, THERE), 1, ""), 10.0)
    scene.drop(("198.51.100.1", 5790), 10.0 + PLACES_S)
    now = 10.0 + PLACES_S
    assert scene.evidence.seen(DropReason.BAD_HANDSHAKE, link, now) is None
    assert scene.evidence.seen_at(DropReason.BAD_HANDSHAKE, ("relay", "drone1"), now) is None
    seen = scene.evidence.seen_at(DropReason.BAD_HANDSHAKE, ("relay", "vps"), now)
    assert seen is not None
    assert seen.address == THERE


def test_evidence_at_an_address_is_not_that_of_another_peer_of_its_host(scene: Scene) -> None:
    """Two peers behind one router have different ports."""
    other = scene.add("drone2", bytes([3]) * 32, [(HOST, 5791)])
    scene.drop(THERE, 10.0)
    assert scene.seen(scene.link, 10.0) is not None
    assert scene.seen(other, 10.0) is None


def test_a_flood_takes_no_memory(scene: Scene) -> None:
    """Many sources, keys and ports: one entry for each kind and configured place."""
    for number in range(5000):
        scene.drop((f"198.51.{number // 250}.{number % 250}", number), 10.0, number.to_bytes(32, "big"))
        scene.drop((HOST, number), 10.0, number.to_bytes(32, "big"))
    assert len(scene.evidence._sightings) == 2
    assert len(scene.seen(scene.link, 10.0).details) == MAX_DETAILS


def test_evidence_of_a_removed_peer_is_forgotten(scene: Scene) -> None:
    """With the next evidence after a second."""
    scene.drop(THERE, 10.0)
    del scene.links["drone1"]
    scene.drop(THERE, 10.0 + PLACES_S)
    assert [place for _, place in scene.evidence._sightings] == [()]


def test_other_keys_do_not_hide_the_own_one(scene: Scene) -> None:
    """An attacker can make initiations by any number of keys of its own."""
    scene.drop(THERE, 10.0, OWN_KEY)
    for number in range(100):
        scene.drop(THERE, 11.0, number.to_bytes(32, "big"))
    assert scene.evidence.own_key_elsewhere == (10.0, THERE)
    assert OWN_KEY not in scene.seen(scene.link, 11.0).details


def test_errors_of_a_candidate_are_not_those_of_another_peer_of_its_host(scene: Scene) -> None:
    """A candidate of one peer may be another port of the host of a peer that is well."""
    scene.evidence.add_error("EPERM", (HOST, 40000), 1.0)
    scene.evidence.add_error("icmp_ECONNREFUSED", (HOST, 40000), 1.0)
    for kind in ("EPERM", f"{REPORTED}ECONNREFUSED"):
        assert scene.evidence.seen(kind, scene.link, 1.0) is None
        assert scene.evidence.seen_at(kind, ELSEWHERE, 1.0) is not None


def test_growth_is_remembered_and_begins_again() -> None:
    """A counter that restarts at zero counts from there; one that is quiet for long is forgotten."""
    growth = RecentGrowth[str]()
    assert growth.update({"a": 3, "b": 1}, 0.0) == {"a": 3, "b": 1}
    assert growth.update({"a": 3, "b": 1}, 1.0) == {}
    assert growth.update({"a": 5, "b": 1}, 2.0) == {"a": 2}
    assert growth.within(1.0, 2.0) == {"a": 5}
    assert growth.within(2.0, 2.0) == {"a": 5, "b": 1}
    assert growth.update({"a": 1}, 3.0) == {"a": 1}
    assert growth.within(1.0, 3.0) == {"a": 6}
    growth.update({"a": 1, "c": 1}, 4.0 + REMEMBERED_S)
    assert set(growth._recent) == {"c"}


BLOCKED_IN = [("peer", "drone1", "in")]


class Traffic:
    """The history of a peer that may speak as system 2 only, second by second."""

    def __init__(self) -> None:
        self.history, self.now = History(0.0), 0.0
        pacer = SimpleNamespace(egress=None)
        self.link: Any = SimpleNamespace(name="drone1", counters=SplitCounters(), frames_sent=0, pacer=pacer)
        self.policy({"role": "all", "system_ids": [2]})

    def policy(self, rules: dict[str, object]) -> None:
        """Replace it."""
        self.link.policy = Policy(rules, is_local=False)

    def blocked(self, *received: int, sent: bool = False, seconds: int = 1) -> list[tuple[str, str, str]]:
        """What is blocked after a second with frames of these systems, and further ones without."""
        for frame in split_payload(b"".join(map(heartbeat, received)), self.link.counters):
            self.link.policy.incoming.check(frame, self.now)
        if sent:
            (frame,) = split_payload(heartbeat(1), SplitCounters())
            self.link.frames_sent += self.link.policy.outgoing.check(frame, self.now) is None
        for _ in range(seconds):
            self.now += 1.0
            self.history.sample([self.link], [], self.now)
        return self.history.blocked(self.now)


def test_growth_lasts_only_without_a_pause() -> None:
    """From 5 s on. A single error, now and then, does not last."""
    growth = RecentGrowth[str]()
    for now, count, lasts in ((0, 1, False), (4, 2, False), (5, 3, True), (10, 4, True), (16, 5, False)):
        growth.update({"EPERM": count}, float(now))
        assert growth.lasting(float(now)) == ["EPERM"] * lasts
    assert growth.lasting(30.0) == []


def test_peer_whose_frames_are_all_refused_is_blocked() -> None:
    """From the first one until one passes, or until none came for ten seconds. An earlier passed frame hides none."""
    traffic = Traffic()
    assert traffic.blocked() == []
    assert traffic.blocked(7) == BLOCKED_IN
    assert traffic.blocked(7, 2) == []
    assert traffic.blocked(7, seconds=10) == BLOCKED_IN
    assert traffic.blocked() == []


def test_frames_that_are_all_withheld_are_blocked() -> None:
    """The same towards the peer."""
    traffic = Traffic()
    traffic.policy({"system_ids": "all", "allow_in": ["all"], "allow_out": ["PING"]})
    assert traffic.blocked(sent=True) == [("peer", "drone1", "out")]


def test_policy_that_passes_nothing_is_intended() -> None:
    """``allow_in = []`` says that no frame of the peer is wanted."""
    traffic = Traffic()
    traffic.policy({"system_ids": "all", "allow_in": [], "allow_out": []})
    assert traffic.blocked(1, sent=True) == []


def test_new_policy_starts_its_counts_at_zero() -> None:
    """What the policy before refused is past at once: the operator has repaired it."""
    traffic = Traffic()
    assert traffic.blocked(7, 7, 7) == BLOCKED_IN
    traffic.policy({"role": "all", "system_ids": [3]})
    assert traffic.blocked() == []
    assert traffic.blocked(7) == BLOCKED_IN
