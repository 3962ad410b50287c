"""A private key in two processes is shown by what they state in handshakes: not by an attacker without the key that
forwards, replays or withholds datagrams, nor by a restart with one late datagram.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.core.harness import _KEYS, PLAIN, Pair, Side, datagrams, exchange, only, seeded
from uavlinkd.core import constants as c
from uavlinkd.core import establish, wire
from uavlinkd.core.crypto import Secret
from uavlinkd.core.node import Node
from uavlinkd.core.path import Path
from uavlinkd.core.sessions import Twin
from uavlinkd.core.settings import PeerSettings

AT_TWIN = Path(0, ("192.0.2.99", 5790))


def another_alpha(pair: Pair, seed: int = 9) -> Side:
    """A process with alpha's key: the same one after a restart, or another machine."""
    node = Node(Secret(_KEYS[0]), seeded(seed), 0.0)
    node.add_peer(PeerSettings("bravo", pair.b.node.public_key, None, PLAIN), 0.0)
    return Side(node, AT_TWIN, "bravo", pair.b.at)


def initiation(side: Side, now: float) -> bytes:
    """A new one, whatever is pending."""
    side.configure_path(now)
    return only(datagrams(establish.initiate(side.peer, now), wire.INITIATION))


def link(pair: Pair, side: Side, now: float) -> None:
    """A process with alpha's key makes a session with bravo, and sends on it."""
    response = only(datagrams(pair.b.receive(initiation(side, now), now, side.at), wire.RESPONSE))
    exchange(pair.b, side, side.receive(response, now), now)


def twins(*sides: Side) -> list[dict[Twin, float]]:
    """What each knows."""
    return [side.peer.sessions.twins for side in sides]


def test_two_handshakes_of_the_first_machine_show_the_other_one() -> None:
    """To the peer and to itself, and the second one of the other machine shows it there."""
    pair = Pair().establish()
    clone = another_alpha(pair)
    link(pair, clone, 1.0)
    link(pair, pair.a, 2.0)
    link(pair, clone, 3.0)
    assert twins(pair.a, pair.b, clone) == [{}, {}, {}], "it may be a restart"
    link(pair, pair.a, 4.0)
    assert twins(pair.a, pair.b, clone) == [{Twin.OURS: 4.0}, {Twin.PEERS: 4.0}, {}]
    link(pair, clone, 5.0)
    assert twins(pair.b, clone) == [{Twin.PEERS: 5.0}, {Twin.OURS: 5.0}]


def test_the_peers_own_initiation_shows_it_too() -> None:
    """Bravo initiates to the first machine, and states what it has with the clone."""
    pair = Pair().establish()
    clone = another_alpha(pair)
    for now in (1.0, 4.0):
        assert twins(pair.a) == [{}]
        link(pair, clone, now)
        response = only(datagrams(pair.a.receive(initiation(pair.b, now + 1), now + 1), wire.RESPONSE))
        assert twins(pair.a) == [{}], "it may be an old recording"
        exchange(pair.a, pair.b, pair.b.receive(response, now + 1), now + 1)
    assert twins(pair.a) == [{Twin.OURS: 5.0}]


def withholds_confirmation(pair: Pair) -> None:
    """Bravo uses a session that alpha never confirmed, and that alpha has forgotten."""
    pair.b.receive(only(datagrams(pair.a.receive(initiation(pair.b, 1.0), 1.0), wire.RESPONSE)), 1.0)
    assert (pair.a.peer.sessions.generation, pair.b.peer.sessions.generation) == (1, 2)
    pair.a.timeout(1.0 + c.UNCONFIRMED_LIFETIME_S)
    assert not pair.a.peer.sessions.unconfirmed


def delivers_an_old_initiation(pair: Pair) -> None:
    """It was held back while another one made a session."""
    old = initiation(pair.a, 1.0)
    link(pair, pair.a, 2.0)
    response = only(datagrams(pair.b.receive(old, 3.0, AT_TWIN), wire.RESPONSE))
    pair.a.receive(response, 3.0)


def replays_after_a_restart(pair: Pair) -> None:
    """Bravo's initiation of a high generation, to alpha that begins with low ones."""
    for second in range(1, 9):
        link(pair, pair.a, float(second))
    old = initiation(pair.b, 9.0)
    pair.a = another_alpha(pair, 8)
    link(pair, pair.a, 10.0)
    assert datagrams(pair.a.receive(old, 10.0), wire.RESPONSE)


def forwards(pair: Pair) -> None:
    """Each session is made through the attacker's address, or not."""
    for second in range(1, 9):
        pair.a.at = (pair.a.at, AT_TWIN)[second % 2]
        link(pair, pair.a, float(second))


def releases_after_a_restart(pair: Pair) -> None:
    """A confirmation of the process before: one handshake looks like another machine's, the next one does not."""
    for now in (1.0, 2.0):
        response = only(datagrams(pair.b.receive(initiation(pair.a, now), now), wire.RESPONSE))
        (confirmation,) = datagrams(pair.a.receive(response, now))
    pair.a = another_alpha(pair, 8)
    link(pair, pair.a, 3.0)
    pair.b.receive(confirmation, 4.0)
    link(pair, pair.a, 5.0)
    link(pair, pair.a, 7.0)


@pytest.mark.parametrize(
    "attack",
    [withholds_confirmation, delivers_an_old_initiation, replays_after_a_restart, forwards, releases_after_a_restart],
)
def test_an_attacker_without_the_key_makes_no_twin(attack: Callable[[Pair], None]) -> None:
    """Nor does the change of keys or the restart that follows."""
    pair = Pair().establish()
    attack(pair)
    link(pair, pair.a, 20.0)
    link(pair, pair.a, 21.0)
    before, pair.a = pair.a, another_alpha(pair)
    link(pair, pair.a, 22.0)
    link(pair, pair.a, 23.0)
    assert twins(before, pair.a, pair.b) == [{}, {}, {}]
