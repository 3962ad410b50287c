"""Causes of a link that is down which a test on loopback cannot have: firewalls, routes, names, other networks."""

from __future__ import annotations

import errno
import socket
from types import SimpleNamespace
from typing import Any

import pytest

from tests.link.test_evidence import HOST, OWN_KEY, THERE, Scene
from uavlinkd.core import constants as c
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Dropped
from uavlinkd.core.path import Path
from uavlinkd.endpoints.sockets import is_here
from uavlinkd.link.down_causes import link_down
from uavlinkd.link.history import History
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Finding

NOW = 1.0


class Diagnosed(Scene):
    """A peer that is down, and what its daemon knows."""

    def __init__(self) -> None:
        super().__init__()
        self.sockets: Any = SimpleNamespace(
            unresolved=lambda name: set[str](),
            without_socket=set(),
            absent_addresses=list,
            networks=None,
            is_own=lambda address: False,
        )
        self.history = History(0.0)
        self.daemon: Any = SimpleNamespace(
            config=SimpleNamespace(name="drone0", public_key=OWN_KEY),
            links=self.links,
            peer_sockets=self.sockets,
            evidence=self.evidence,
            history=self.history,
        )

    def findings(self, now: float = NOW) -> dict[str, Finding]:
        """The findings, by cause."""
        return {finding.cause: finding for finding in link_down(self.daemon, self.link, now)}

    def bad_mac1(self, now: float = NOW) -> None:
        """A sender at the peer's address does not know this daemon's key."""
        self.evidence.add_dropped(Dropped(DropReason.BAD_MAC1, None, Path(0, THERE)), now)


@pytest.fixture
def scene() -> Diagnosed:
    return Diagnosed()


@pytest.mark.parametrize(
    ("error", "cause"),
    [("EPERM", Cause.FIREWALL_HERE), ("ENETUNREACH", Cause.NO_ROUTE), ("EINVAL", Cause.NO_ROUTE)],
)
def test_errors_of_this_machine(scene: Diagnosed, error: str, cause: Cause) -> None:
    """They name the address and the error."""
    scene.evidence.add_failure(error, THERE, NOW)
    assert set(scene.findings()) == {cause}
    assert f"{HOST}:5790" in scene.findings()[cause].text
    assert error in scene.findings()[cause].text


def test_absent_own_address_explains_that_nothing_can_be_sent(scene: Diagnosed) -> None:
    """It has a line of its own, so the peers have none about routes."""
    scene.evidence.add_failure("EINVAL", THERE, NOW)
    scene.sockets.absent_addresses = lambda: ["192.0.2.77:5790"]
    assert scene.findings() == {}


@pytest.mark.parametrize(
    ("number", "cause"), [(errno.ECONNREFUSED, Cause.NO_LISTENER), (errno.EHOSTUNREACH, Cause.HOST_UNREACHABLE)]
)
def test_reports_of_the_network(scene: Diagnosed, number: int, cause: Cause) -> None:
    """Each error of ICMP has its cause."""
    scene.evidence.add_report(number, THERE, NOW)
    assert set(scene.findings()) == {cause}


def test_name_without_an_address(scene: Diagnosed) -> None:
    """Each name that does not resolve is named."""
    scene.sockets.unresolved = lambda name: {"b.test", "a.test"}
    assert scene.findings()[Cause.NAME_NOT_RESOLVED].text.startswith("a.test, b.test ")


def test_link_local_address_without_interface(scene: Diagnosed) -> None:
    """A name may have one; a file cannot."""
    scene.link.set_paths([Path(0, ("fe80::1", 5790, 0, 2))], NOW)
    assert scene.findings() == {}
    scene.link.set_paths([Path(0, ("fe80::1", 5790, 0, 0))], NOW)
    assert "[fe80::1%wlan0]:5790" in scene.findings()[Cause.ZONE_MISSING].remedy


def test_address_of_this_daemon(scene: Diagnosed) -> None:
    """Its own initiations arrive: no other end has a wrong key."""
    scene.bad_mac1()
    assert set(scene.findings()) == {Cause.WRONG_KEY_THERE}
    scene.sockets.is_own = lambda address: address == THERE
    assert set(scene.findings()) == {Cause.OWN_ADDRESS}


def test_evidence_from_before_the_link_went_down_does_not_count(scene: Diagnosed) -> None:
    """Also what an attacker sent while it was up."""
    scene.bad_mac1(NOW)
    scene.link.silent_since = NOW + 1.0
    assert scene.findings(NOW + 2.0) == {}
    assert set(scene.findings(NOW + 20.0)) == {Cause.NO_ANSWER}


def test_other_version_names_the_older_side(scene: Diagnosed) -> None:
    """It explains the initiations above the limit of comparisons, which count as for another key."""
    scene.bad_mac1()
    older, newer = c.PROTOCOL_VERSION - 1, c.PROTOCOL_VERSION + 1
    for version, remedy in (
        (older, "update uavlinkd at drone1:"),
        (newer, "; update uavlinkd at drone0, this machine"),
    ):
        scene.evidence.add_dropped(Dropped(DropReason.OTHER_VERSION, None, Path(0, THERE), 1, version), NOW)
        findings = scene.findings()
        assert set(findings) == {Cause.OTHER_VERSION}
        assert f"uavlink/{version}, this daemon uavlink/{c.PROTOCOL_VERSION}" in findings[Cause.OTHER_VERSION].text
        assert remedy in findings[Cause.OTHER_VERSION].remedy


def test_several_keys_from_one_address(scene: Diagnosed) -> None:
    """At least one sender is not the peer; the former key and the others have lines of their own."""
    keys = [bytes([number]) * 32 for number in (11, 12, 13)]
    scene.history.add_former_key(keys[0], "drone1")
    for key in keys:
        scene.drop(THERE, NOW, key)
    findings = scene.findings()
    assert set(findings) == {Cause.FORMER_KEY, Cause.WRONG_KEY_HERE}
    assert "2 keys, so at least one is not drone1" in findings[Cause.WRONG_KEY_HERE].text
    assert "or an attacker replays an old recording" in findings[Cause.FORMER_KEY].text


def test_remedies_weaken_nothing_if_the_evidence_is_forged(scene: Diagnosed) -> None:
    """One changed byte of a response, or an old initiation, must not cost a PSK or a strong suite."""
    for reason, detail in ((DropReason.BAD_HANDSHAKE, ""), (DropReason.SUITE_NOT_ACCEPTED, "x25519")):
        scene.evidence.add_dropped(Dropped(reason, scene.link.peers[0], Path(0, THERE), 1, detail), NOW)
    findings = scene.findings()
    assert "never remove a PSK: the message may be forged" in findings[Cause.WRONG_PSK].remedy
    assert "neither" not in findings[Cause.WRONG_PSK].remedy
    assert "write this end's suites at drone1" in findings[Cause.NO_COMMON_SUITE].remedy
    assert "an old recording can cause this" in findings[Cause.NO_COMMON_SUITE].remedy


def test_addresses_of_this_machine() -> None:
    """As the kernel says."""
    assert is_here(socket.AF_INET, ("127.0.0.1", 0))
    assert not is_here(socket.AF_INET, ("192.0.2.77", 0))
