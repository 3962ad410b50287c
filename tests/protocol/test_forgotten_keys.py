"""Keys of the past are dropped: no object that holds them is left anywhere in the process."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from tests.protocol.harness import Pair, datagrams, exchange, quiet
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import AeadKey, MacKey
from uavlinkd.protocol.initiator import Pending
from uavlinkd.protocol.noise import HandshakeState, SymmetricState
from uavlinkd.protocol.session import Session

REKEYS = 6
KEEPERS = (Session, MacKey, AeadKey, HandshakeState, SymmetricState, Pending)


@pytest.fixture(autouse=True)
def without_collector() -> Iterator[None]:
    """Objects are freed by reference count alone: a collector may run late, and keys must not wait for it."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


class Census:
    """Objects that hold keys, but for those that were there before."""

    def __init__(self) -> None:
        self._before = {id(thing): thing for thing in gc.get_objects() if isinstance(thing, KEEPERS)}

    def count(self, *kinds: type) -> int:
        """How many there are now."""
        return sum(isinstance(thing, kinds) and id(thing) not in self._before for thing in gc.get_objects())


@pytest.mark.parametrize("confidential", [False, True])
@pytest.mark.long
def test_rekeying_leaves_no_more_sessions_than_may_be_used(confidential: bool) -> None:
    """Of many sessions those remain that may still receive; when they are too old, the current one alone."""
    census = Census()
    link = quiet(confidential=confidential)
    pair = Pair(link_a=link, link_b=link)
    now = 0.0
    for _ in range(REKEYS):
        pair.establish(now)
        now += c.REKEY_AFTER_S
    assert 2 <= census.count(Session) <= 2 * c.USABLE_PER_PEER
    pair.establish(now)
    now += c.REKEY_AFTER_S - 1.0  # the one before it is now older than sessions get
    for side in (pair.a, pair.b):
        side.timeout(now)
    assert census.count(Session) == 2
    assert census.count(MacKey, AeadKey) == 4, "one per direction, at each end"
    assert census.count(HandshakeState, SymmetricState, Pending) == 0, "handshakes that are over keep nothing"


def test_nothing_is_left_of_a_peer_that_is_removed() -> None:
    """Cut off, its keys are gone at once, those of a handshake that was under way too."""
    census = Census()
    pair = Pair(link_a=quiet(), link_b=quiet()).establish(0.0)
    pair.initiation(c.REKEY_AFTER_S)
    assert census.count(*KEEPERS) > 4
    peer = weakref.ref(pair.a.peer)
    pair.a.node.remove_peer(pair.a.peer, c.REKEY_AFTER_S)
    pair.b.node.remove_peer(pair.b.peer, c.REKEY_AFTER_S)
    assert census.count(*KEEPERS) == 0
    assert peer() is None


def test_nothing_is_left_of_a_session_that_was_closed() -> None:
    """Of the current one, which carried a frame of a stream a moment ago, neither: no later frame has to come."""
    census = Census()
    pair = Pair(link_a=quiet(), link_b=quiet()).establish(0.0)
    exchange(pair.b, pair.a, pair.a.send(0.1), 0.1)
    for datagram in datagrams(pair.b.node.close(1.0)):
        pair.a.receive(datagram, 1.0)
    pair.a.timeout(3000.0)
    assert pair.a.peer.sessions.current is None
    assert census.count(Session, MacKey) == 0
