"""Initiations of other versions of the protocol: named, never answered, and at no cost that a flood could raise."""

from __future__ import annotations

import pytest

from tests.core.harness import (
    AT_A,
    ELSEWHERE,
    KEY_A,
    KEY_B,
    Pair,
    initiation_of,
    of,
    reasons,
    seeded,
    state_of,
)
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Dropped
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.core.versions import OTHERS, version_of

LENGTHS = [wire.initiation_bytes(SUITES_BY_NAME["x25519"]), wire.MACS_BYTES + 1, 900, c.VERSION_CHECK_BYTES]


def test_every_version_but_ours_is_compared() -> None:
    """Ours is among the known ones: the next version can name it."""
    assert sorted((*OTHERS, c.PROTOCOL_VERSION)) == list(range(1, c.LAST_KNOWN_VERSION + 1))
    assert f"uavlink/{c.PROTOCOL_VERSION}".encode() == c.PROTOCOL_NAME


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("version", OTHERS)
def test_other_version_is_named_and_not_answered(version: int, length: int) -> None:
    """The drop has the version, whatever the length of the message. No datagram goes out, and no state changes."""
    pair = Pair().establish()
    before = state_of(pair.b.node)
    outputs = pair.b.receive(initiation_of(version, KEY_B.public, length), 1.0, ELSEWHERE)
    assert outputs == [Dropped(DropReason.OTHER_VERSION, None, ELSEWHERE, 1, version)]
    assert state_of(pair.b.node) == before
    assert pair.b.node.drops == {DropReason.OTHER_VERSION: 1}


@pytest.mark.parametrize("length", [wire.MACS_BYTES, c.VERSION_CHECK_BYTES + 1])
def test_message_outside_the_lengths_is_not_compared(length: int) -> None:
    """One that consists of its macs, and one that takes long to hash."""
    assert version_of(initiation_of(1, KEY_B.public, length), [KEY_B.public]) is None


@pytest.mark.parametrize(
    "initiation",
    [
        initiation_of(1, KEY_A.public),
        initiation_of(c.LAST_KNOWN_VERSION + 1, KEY_B.public),
        b"\1\7" + initiation_of(1, KEY_B.public)[2:],
    ],
    ids=["for another key", "later than the known ones", "altered"],
)
def test_other_initiations_are_of_no_version(initiation: bytes) -> None:
    """A drop names a version only if mac1 fits."""
    assert reasons(Pair().b.receive(initiation, 1.0)) in ([DropReason.MALFORMED], [DropReason.BAD_MAC1])


@pytest.mark.parametrize("kind", [wire.RESPONSE, wire.COOKIE, 0x40, 0xFD])
def test_only_initiations_are_compared(kind: int) -> None:
    """No daemon answers another version, so other messages of one do not arrive."""
    message = bytes((kind,)) + initiation_of(1, KEY_B.public)[1:]
    assert reasons(Pair().b.receive(message, 1.0)) != [DropReason.OTHER_VERSION]


def test_initiation_for_the_previous_key_is_named_too() -> None:
    """While keys change, a peer may know either key; afterwards only the new one."""
    new, old = (bytes([number]) * 32 for number in (11, 12))
    node = Node(Secret(new), seeded(1), 0.0, Secret(old))
    for key in (new, old):
        (dropped,) = of(node.receive(initiation_of(1, KeyPair(key).public), AT_A, 1.0), Dropped)
        assert (dropped.reason, dropped.detail) == (DropReason.OTHER_VERSION, 1)
    node.forget_previous_key()
    (dropped,) = of(node.receive(initiation_of(1, KeyPair(old).public), AT_A, 1.0), Dropped)
    assert dropped.reason is not DropReason.OTHER_VERSION


def test_flood_leaves_known_addresses_their_comparisons() -> None:
    """Above the limit the reason is as if no version were known; it is counted, and costs one HMAC at most."""
    pair = Pair().establish()
    initiation = initiation_of(1, KEY_B.public)
    flood = [reasons(pair.b.receive(initiation, 1.0, ELSEWHERE)) for _ in range(3 * c.VERSION_CHECKS_BURST)]
    assert flood.count([DropReason.OTHER_VERSION]) == c.VERSION_CHECKS_BURST
    assert len(flood) - c.VERSION_CHECKS_BURST == sum(
        flood.count([reason]) for reason in (DropReason.MALFORMED, DropReason.BAD_MAC1)
    )
    known = [reasons(pair.b.receive(initiation, 1.0, AT_A)) for _ in range(2 * c.VERSION_CHECKS_PER_KNOWN_BURST)]
    assert known.count([DropReason.OTHER_VERSION]) == c.VERSION_CHECKS_PER_KNOWN_BURST
    later = [reasons(pair.b.receive(initiation, 2.0, ELSEWHERE)) for _ in range(2 * c.VERSION_CHECKS_PER_S)]
    assert later.count([DropReason.OTHER_VERSION]) == c.VERSION_CHECKS_PER_S
    assert pair.carries(2.0)


def test_tries_of_a_peer_stay_within_its_share() -> None:
    """At the shortest interval, and while a flood spends the share of all others."""
    pair = Pair().establish()
    initiation = initiation_of(1, KEY_B.public)
    for number in range(100):
        now = 1.0 + number * c.RETRY_MIN_S
        for _ in range(c.VERSION_CHECKS_BURST):
            pair.b.receive(initiation, now, ELSEWHERE)
        assert reasons(pair.b.receive(initiation, now, AT_A)) == [DropReason.OTHER_VERSION]
