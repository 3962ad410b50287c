"""A node whose key is being changed: it can be known by either, each peer by the key that it knows."""

from __future__ import annotations

import pytest

from tests.core.harness import AT_A, AT_B, FRAME, QUIET, datagrams, only, payloads, reasons, seeded
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.path import Path
from uavlinkd.core.settings import Link, PeerSettings

LINK = Link(timers=QUIET)
OLD, NEW, OTHER = (bytes([number]) * 32 for number in (11, 12, 13))
PUBLIC = {private: KeyPair(private).public for private in (OLD, NEW, OTHER)}


def changing() -> Node:
    """Its key was OLD and is NEW; its peer may know it by either."""
    node = Node(Secret(NEW), seeded(1), 0.0, Secret(OLD))
    settings = PeerSettings("other", PUBLIC[OTHER], None, LINK)
    node.add_peer(settings, 0.0)
    node.add_peer(PeerSettings("other by old", PUBLIC[OTHER], None, LINK), 0.0, by_previous_key=True)
    return node


def other(knows: bytes) -> Node:
    """The peer, who knows one key and where its holder is."""
    node = Node(Secret(OTHER), seeded(2), 0.0)
    node.add_peer(PeerSettings("node", PUBLIC[knows], None, LINK), 0.0)
    node.set_paths(node.peers["node"], [AT_A], 0.0)
    return node


@pytest.mark.parametrize(("known", "name"), [(NEW, "other"), (OLD, "other by old")], ids=["new", "old"])
def test_peer_is_linked_by_the_key_that_it_knows(known: bytes, name: str) -> None:
    """Whichever of the two keys a peer has, the Node answers with that key, and frames pass in both directions."""
    node, peer = changing(), other(known)
    response = only(datagrams(node.receive(only(datagrams(peer.handle_timeout(0.0))), AT_B, 0.0)))
    node.receive(only(datagrams(peer.receive(response, AT_A, 0.0))), AT_B, 0.0)

    assert [peer_name for peer_name, state in node.peers.items() if state.is_up] == [name]
    out = only(datagrams(node.send(node.peers[name], [FRAME], 1.0)))
    assert payloads(peer.receive(out, AT_A, 1.0)) == [FRAME]
    back = only(datagrams(peer.send(peer.peers["node"], [FRAME], 1.0)))
    assert payloads(node.receive(back, AT_B, 1.0)) == [FRAME]


@pytest.mark.parametrize("known", [NEW, OLD], ids=["new", "old"])
def test_node_initiates_with_each_key_that_the_peer_may_know(known: bytes) -> None:
    """The Node initiates with both keys, and the peer answers the initiation with the key that it knows."""
    node, peer = changing(), other(known)
    for name in node.peers:
        node.set_paths(node.peers[name], [AT_B], 0.0)
    initiations = datagrams(node.handle_timeout(0.0), wire.INITIATION)
    answers = [peer.receive(initiation, AT_A, 0.0) for initiation in initiations]

    assert sorted(len(datagrams(outputs)) for outputs in answers) == [0, 1]
    assert [reasons(outputs) for outputs in answers if reasons(outputs)] == [[DropReason.UNKNOWN_PEER]]
    response = only([datagram for outputs in answers for datagram in datagrams(outputs)])
    assert len(datagrams(node.receive(response, AT_B, 0.0))) == 1


@pytest.mark.parametrize("known", [NEW, OLD], ids=["new", "old"])
def test_cookie_is_for_the_key_of_the_initiation(known: bytes) -> None:
    """Under load an initiator can open its cookie with either key, and is admitted with it."""
    node, peer = changing(), other(known)
    for number in range(c.INITIATIONS_BURST):
        stranger = Node(Secret(bytes([100 + number % 50]) * 32), seeded(number), 0.0)
        stranger.add_peer(PeerSettings("node", PUBLIC[NEW], None, LINK), 0.0)
        stranger.set_paths(stranger.peers["node"], [AT_A], 0.0)
        node.receive(only(datagrams(stranger.handle_timeout(0.0))), Path(0, ("192.0.2.66", number)), 0.0)
    cookie = only(datagrams(node.receive(only(datagrams(peer.handle_timeout(0.0))), AT_B, 0.0)))
    assert cookie[0] == wire.COOKIE
    assert peer.receive(cookie, AT_A, 0.0) == []

    again = only(datagrams(peer.handle_timeout(peer.next_deadline())))
    assert only(datagrams(node.receive(again, AT_B, 0.001)))[0] == wire.RESPONSE


def test_message_for_neither_key_is_dropped() -> None:
    """An initiator that knows neither key gets no answer."""
    stranger = other(OTHER_NODE)
    initiation = only(datagrams(stranger.handle_timeout(0.0)))

    assert reasons(changing().receive(initiation, AT_B, 0.0)) == [DropReason.BAD_MAC1]


OTHER_NODE = bytes([14]) * 32
PUBLIC[OTHER_NODE] = KeyPair(OTHER_NODE).public


def test_removing_one_pair_of_keys_leaves_the_other() -> None:
    """Once the new key is confirmed, an initiation to the old key is dropped, and one to the new key answered."""
    node = changing()
    node.remove_peer(node.peers["other by old"], 0.0)
    by_old, by_new = (only(datagrams(other(known).handle_timeout(0.0))) for known in (OLD, NEW))

    assert reasons(node.receive(by_old, AT_B, 0.0)) == [DropReason.UNKNOWN_PEER]
    assert len(datagrams(node.receive(by_new, AT_B, 0.0))) == 1


def test_peers_that_cannot_be_are_refused() -> None:
    """A pair of keys is one peer's, none has a key of ours, and there must be a previous key to be known by."""
    node = changing()
    with pytest.raises(ValueError, match="there already"):
        node.add_peer(PeerSettings("again", PUBLIC[OTHER]), 0.0, by_previous_key=True)
    for own in (OLD, NEW):
        with pytest.raises(ValueError, match="own key"):
            node.add_peer(PeerSettings("self", PUBLIC[own]), 0.0)
    with pytest.raises(ValueError, match="has only one"):
        other(NEW).add_peer(PeerSettings("late", PUBLIC[OLD]), 0.0, by_previous_key=True)


def test_forgotten_key_may_belong_to_a_peer() -> None:
    """Nothing is for it any more, and a peer may have it: the identity that was ours moved to another machine."""
    node, initiator = changing(), other(OLD)
    node.remove_peer(node.peers["other by old"], 0.0)
    with pytest.raises(ValueError, match="own key"):
        node.add_peer(PeerSettings("heir", PUBLIC[OLD]), 0.0)
    node.forget_previous_key()
    node.add_peer(PeerSettings("heir", PUBLIC[OLD]), 0.0)
    assert reasons(node.receive(only(datagrams(initiator.handle_timeout(0.0))), AT_B, 0.0)) == [DropReason.BAD_MAC1]
