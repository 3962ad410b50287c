"""A node whose key is being changed: it can be known by either, each peer by the key that it knows."""

from __future__ import annotations

import pytest

from tests.core.harness import AT_A, AT_B, FRAME, QUIET, datagrams, of, only, payloads, reasons, seeded
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Dropped
from uavlinkd.core.path import Path
from uavlinkd.core.settings import Link, PeerSettings

LINK = Link(timers=QUIET)
OLD, NEW, OTHER, STRANGER = (bytes([number]) * 32 for number in (11, 12, 13, 14))
PUBLIC = {private: KeyPair(private).public for private in (OLD, NEW, OTHER, STRANGER)}
either = pytest.mark.parametrize(("known", "name"), [(NEW, "other"), (OLD, "other by old")], ids=["new", "old"])


def changing() -> Node:
    """Its key was OLD and is NEW; its peer may know it by either."""
    node = Node(Secret(NEW), seeded(1), 0.0, Secret(OLD))
    settings = PeerSettings("other", PUBLIC[OTHER], None, LINK)
    node.add_peer(settings, 0.0)
    node.add_peer(PeerSettings("other by old", PUBLIC[OTHER], None, LINK), 0.0, by_previous_key=True)
    return node


def other(knows: bytes, private: bytes = OTHER, seed: int = 2) -> Node:
    """The peer, who knows one key and where its holder is."""
    node = Node(Secret(private), seeded(seed), 0.0)
    node.set_paths(node.add_peer(PeerSettings("node", PUBLIC[knows], None, LINK), 0.0), [AT_A], 0.0)
    return node


def initiation(node: Node, now: float = 0.0) -> bytes:
    """The initiation that a node sends now."""
    return only(datagrams(node.handle_timeout(now)))


@either
def test_peer_is_linked_by_the_key_that_it_knows(known: bytes, name: str) -> None:
    """Whichever of the two keys a peer has, the Node answers with that key, and frames pass in both directions."""
    node, peer = changing(), other(known)
    response = only(datagrams(node.receive(initiation(peer), AT_B, 0.0)))
    node.receive(only(datagrams(peer.receive(response, AT_A, 0.0))), AT_B, 0.0)
    assert [peer_name for peer_name, state in node.peers.items() if state.is_up] == [name]
    out = only(datagrams(node.send(node.peers[name], [FRAME], 1.0)))
    assert payloads(peer.receive(out, AT_A, 1.0)) == [FRAME]
    back = only(datagrams(peer.send(peer.peers["node"], [FRAME], 1.0)))
    assert payloads(node.receive(back, AT_B, 1.0)) == [FRAME]


@either
def test_cookie_is_for_the_key_of_the_initiation(known: bytes, name: str) -> None:
    """Under load an initiator can open its cookie with either key, and is admitted with it."""
    node, peer = changing(), other(known)
    for number in range(c.INITIATIONS.burst):
        node.receive(initiation(other(NEW, STRANGER, number)), Path(0, ("192.0.2.66", number)), 0.0)
    cookie = only(datagrams(node.receive(initiation(peer), AT_B, 0.0)))
    assert cookie[0] == wire.COOKIE
    assert peer.receive(cookie, AT_A, 0.0) == []
    again = initiation(peer, peer.next_deadline())
    assert only(datagrams(node.receive(again, AT_B, 0.001)))[0] == wire.RESPONSE


def test_message_for_no_valid_key_is_dropped() -> None:
    """For neither key, or for the previous one once it is removed or forgotten: another machine may have it."""
    node, by_old = changing(), initiation(other(OLD))
    assert reasons(node.receive(initiation(other(STRANGER)), AT_B, 0.0)) == [DropReason.BAD_MAC1]
    node.remove_peer(node.peers["other by old"], 0.0)
    assert of(node.receive(by_old, AT_B, 0.0), Dropped)[0].reason is DropReason.UNKNOWN_PEER
    assert len(datagrams(node.receive(initiation(other(NEW)), AT_B, 0.0))) == 1
    with pytest.raises(ValueError, match="own key"):
        node.add_peer(PeerSettings("heir", PUBLIC[OLD]), 0.0)
    node.forget_previous_key()
    node.add_peer(PeerSettings("heir", PUBLIC[OLD]), 0.0)
    assert reasons(node.receive(by_old, AT_B, 0.0)) == [DropReason.BAD_MAC1]


def test_peers_that_cannot_be_are_refused() -> None:
    """A pair of keys is one peer's, and none has a key of ours."""
    node = changing()
    with pytest.raises(ValueError, match="there already"):
        node.add_peer(PeerSettings("again", PUBLIC[OTHER]), 0.0, by_previous_key=True)
    for own in (OLD, NEW):
        with pytest.raises(ValueError, match="own key"):
            node.add_peer(PeerSettings("self", PUBLIC[own]), 0.0)
