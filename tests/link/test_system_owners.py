"""Whose a system id is, and what is said about a peer that sends as another."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from tests.core.harness import KEY_B, Pair, quiet
from tests.daemon.frames import heartbeat
from uavlinkd.config import PeerConfig
from uavlinkd.core.settings import PeerSettings
from uavlinkd.link.history import OWN_FRAMES_S, History
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.system_owners import SystemOwners
from uavlinkd.link.traffic_causes import refusals, security
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.mavlink.routing import Router
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Finding


class Ground:
    """A daemon with a local client and two peers: drone3, which may send as 3, and one that may send as any."""

    def __init__(self) -> None:
        self.pair = Pair().establish()
        self.router = Router[Any]()
        self.links: dict[str, PeerLink] = {}
        self.captured = self.add("drone3", [3])
        self.relay = self.add("relay", "all")
        self.router.add_port("client")
        self.now = 0.0
        self.history = History(self.now)
        self.daemon: Any = SimpleNamespace(
            links=self.links,
            history=self.history,
            config=SimpleNamespace(routing=SimpleNamespace(relay=False)),
            switch=SimpleNamespace(router=self.router),
            local=SimpleNamespace(endpoints=[SimpleNamespace(name="autopilot", ports=["client"])]),
        )

    def add(self, name: str, systems: object) -> PeerLink:
        """Another peer."""
        policy = {"role": "swarm-member", "system_ids": systems}
        config = PeerConfig(PeerSettings(name, KEY_B.public, None, quiet()), (), policy)
        link = self.links[name] = PeerLink(config, self.pair.a.node, lambda _: None, 0.0)
        link.peers.append(self.pair.a.peer)
        self.router.add_port(link, is_peer=True)
        return link

    def receive(self, port: object, system: int) -> None:
        """A frame that the policy of its port lets pass."""
        for frame in split_payload(heartbeat(system), SplitCounters()):
            self.router.route(frame, port, self.now)

    def send(self, *, own: int = 0, foreign: int | None = None) -> None:
        """A second in which drone3 sends its own frames, and one as a foreign system."""
        self.now += 1.0
        self.captured.counters.frames += own
        if foreign is not None:
            self.captured.counters.frames += 1
            for frame in split_payload(heartbeat(foreign), SplitCounters()):
                assert self.captured.policy.incoming.check(frame, self.now)
        self.history.sample(self.links.values(), [], self.now)

    def findings(self) -> dict[str, Finding]:
        """The findings about drone3, by cause."""
        owners = SystemOwners(self.daemon)
        about = [
            *security(self.daemon, self.captured, owners, self.now),
            *refusals(self.daemon, self.captured, [], owners, self.now),
        ]
        return {finding.cause: finding for finding in about}


def test_the_system_of_a_client_here() -> None:
    """A peer that sends as the autopilot of this daemon is found, and trusting it is not advised."""
    ground = Ground()
    ground.receive("client", 1)
    for _ in range(3):
        ground.send(own=10, foreign=1)
    findings = ground.findings()
    assert "1 (endpoint autopilot)" in findings[Cause.IMPERSONATION].text
    assert "write it into system_ids" not in findings[Cause.OTHER_SYSTEM].remedy


def test_the_system_of_a_peer_that_may_send_as_any() -> None:
    """The file names none of its systems: those count that were received from it."""
    ground = Ground()
    for _ in range(3):
        ground.send(own=10, foreign=7)
    findings = ground.findings()
    assert Cause.IMPERSONATION not in findings
    assert "only if you know that drone3 has this id" in findings[Cause.OTHER_SYSTEM].remedy
    ground.receive(ground.relay, 7)
    findings = ground.findings()
    assert "7 (relay)" in findings[Cause.IMPERSONATION].text
    assert "write it into system_ids" not in findings[Cause.OTHER_SYSTEM].remedy


def test_owners_are_looked_up_once() -> None:
    """Many peers with many refused systems must not cost their product each second."""
    ground = Ground()
    ground.add("drone2", [2])
    owners = SystemOwners(ground.daemon)
    assert owners.other_than(ground.captured, 2) == "drone2"
    assert owners.other_than(ground.captured, 3) is None
    ground.daemon.links = {}
    assert owners.other_than(ground.relay, 3) == "drone3"


def test_own_and_foreign_frames_in_different_seconds() -> None:
    """Alternating hides nothing; a peer that sent its last own frames long ago only has another id."""
    for pause, is_found in ((1, True), (int(OWN_FRAMES_S) + 1, False)):
        ground = Ground()
        ground.add("drone2", [2])
        for _ in range(3):
            ground.send(own=10)
            for _ in range(pause - 1):
                ground.send()
            ground.send(foreign=2)
        assert (Cause.IMPERSONATION in ground.findings()) is is_found
