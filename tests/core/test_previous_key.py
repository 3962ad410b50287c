"""A node whose key is being changed: it can be known by either, each peer by the key that it knows."""

from __future__ import annotations

import pytest

from tests.core.harness import AT_A, AT_B, FRAME, QUIET, datagrams, only, payloads, reasons, seeded
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
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
    node.set_addresses("node", [AT_A], 0.0)
    return node


@pytest.mark.parametrize(("known", "name"), [(NEW, "other"), (OLD, "other by old")], ids=["new", "old"])
def test_peer_is_linked_by_the_key_that_it_knows(known: bytes, name: str) -> None:
    """Whichever of the two keys a peer has, its call is answered with it, and frames pass both ways."""
    node, peer = changing(), other(known)
    response = only(datagrams(node.receive(only(datagrams(peer.handle_timeout(0.0))), AT_B, 0.0)))
    node.receive(only(datagrams(peer.receive(response, AT_A, 0.0))), AT_B, 0.0)

    assert [each for each in node.peers if node.peers[each].is_up] == [name]
    out = only(datagrams(node.send(name, [FRAME], 1.0)))
    assert payloads(peer.receive(out, AT_A, 1.0)) == [FRAME]
    back = only(datagrams(peer.send("node", [FRAME], 1.0)))
    assert payloads(node.receive(back, AT_B, 1.0)) == [FRAME]


@pytest.mark.parametrize("known", [NEW, OLD], ids=["new", "old"])
def test_node_calls_by_the_key_that_the_peer_may_know(known: bytes) -> None:
    """It calls with both keys, and the peer answers the call of the one that it knows."""
    node, peer = changing(), other(known)
    for name in node.peers:
        node.set_addresses(name, [AT_B], 0.0)
    calls = datagrams(node.handle_timeout(0.0), wire.INITIATION)
    answers = [peer.receive(call, AT_A, 0.0) for call in calls]

    assert sorted(len(datagrams(each)) for each in answers) == [0, 1]
    assert [reasons(each) for each in answers if reasons(each)] == [[DropReason.UNKNOWN_PEER]]
    response = only([datagram for each in answers for datagram in datagrams(each)])
    assert len(datagrams(node.receive(response, AT_B, 0.0))) == 1


@pytest.mark.parametrize("known", [NEW, OLD], ids=["new", "old"])
def test_cookie_is_for_the_key_that_was_called(known: bytes) -> None:
    """Under load a caller can open the cookie that it gets, whichever key it knows, and is let in with it."""
    node, peer = changing(), other(known)
    for number in range(c.INITIATIONS_BURST):
        stranger = Node(Secret(bytes([100 + number % 50]) * 32), seeded(number), 0.0)
        stranger.add_peer(PeerSettings("node", PUBLIC[NEW], None, LINK), 0.0)
        stranger.set_addresses("node", [AT_A], 0.0)
        node.receive(only(datagrams(stranger.handle_timeout(0.0))), (0, "192.0.2.66", number), 0.0)
    cookie = only(datagrams(node.receive(only(datagrams(peer.handle_timeout(0.0))), AT_B, 0.0)))
    assert cookie[0] == wire.COOKIE
    assert peer.receive(cookie, AT_A, 0.0) == []

    again = only(datagrams(peer.handle_timeout(peer.next_deadline())))
    assert only(datagrams(node.receive(again, AT_B, 0.001)))[0] == wire.RESPONSE


def test_message_for_neither_key_is_dropped() -> None:
    """Who knows none of the keys gets no answer."""
    stranger = other(OTHER_NODE)
    call = only(datagrams(stranger.handle_timeout(0.0)))

    assert reasons(changing().receive(call, AT_B, 0.0)) == [DropReason.BAD_MAC1]


OTHER_NODE = bytes([14]) * 32
PUBLIC[OTHER_NODE] = KeyPair(OTHER_NODE).public


def test_removing_one_pair_of_keys_leaves_the_other() -> None:
    """Once the new key is confirmed the old one is nobody's: a call by it is dropped, by the new one answered."""
    node = changing()
    node.remove_peer("other by old", 0.0)
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
    with pytest.raises(ValueError, match="there is none"):
        other(NEW).add_peer(PeerSettings("late", PUBLIC[OLD]), 0.0, by_previous_key=True)


def test_forgotten_key_is_no_key_of_ours() -> None:
    """Nothing is for it any more, and a peer may have it: the identity that was ours moved to another machine."""
    node, caller = changing(), other(OLD)
    node.remove_peer("other by old", 0.0)
    with pytest.raises(ValueError, match="own key"):
        node.add_peer(PeerSettings("heir", PUBLIC[OLD]), 0.0)
    node.forget_previous_key()
    node.add_peer(PeerSettings("heir", PUBLIC[OLD]), 0.0)
    assert reasons(node.receive(only(datagrams(caller.handle_timeout(0.0))), AT_B, 0.0)) == [DropReason.BAD_MAC1]
