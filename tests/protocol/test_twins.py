"""A private key in two processes is shown by what they state in handshakes: not by an attacker without the key that
forwards, replays or withholds datagrams, nor by a restart with one late datagram.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.protocol.harness import _KEYS, PLAIN, Pair, Side, datagrams, exchange, only, seeded
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, wire
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.sessions import Twin
from uavlinkd.protocol.settings import PeerSettings

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


def withholds_confirmation(pair: Pair, at: float) -> None:
    """Bravo uses a session that alpha never confirmed, and that alpha has forgotten."""
    pair.b.receive(only(datagrams(pair.a.receive(initiation(pair.b, at), at), wire.RESPONSE)), at)
    assert pair.a.peer.sessions.generation < pair.b.peer.sessions.generation
    pair.a.timeout(at + c.UNCONFIRMED_LIFETIME_S)
    assert not pair.a.peer.sessions.unconfirmed


def withholds_what_follows(pair: Pair, at: float) -> None:
    """Bravo never learns of the session that alpha uses, and initiates."""
    response = only(datagrams(pair.b.receive(initiation(pair.a, at), at), wire.RESPONSE))
    pair.a.receive(response, at)
    assert pair.b.peer.sessions.generation < pair.a.peer.sessions.generation
    response = only(datagrams(pair.a.receive(initiation(pair.b, at + 1), at + 1), wire.RESPONSE))
    exchange(pair.a, pair.b, pair.b.receive(response, at + 1), at + 1)


def delivers_an_old_initiation(pair: Pair, at: float) -> None:
    """It was held back while another one made a session."""
    old = initiation(pair.a, at)
    link(pair, pair.a, at + 1)
    response = only(datagrams(pair.b.receive(old, at + 2, AT_TWIN), wire.RESPONSE))
    pair.a.receive(response, at + 2)


def replays_after_a_restart(pair: Pair, at: float) -> None:
    """Bravo's initiation of a high generation, to alpha that begins with low ones."""
    for second in range(8):
        link(pair, pair.a, at + second)
    old = initiation(pair.b, at + 8)
    pair.a = another_alpha(pair, 10 + round(at))
    link(pair, pair.a, at + 9)
    assert datagrams(pair.a.receive(old, at + 9), wire.RESPONSE)


def forwards(pair: Pair, at: float) -> None:
    """Each session is made through the attacker's address, or not."""
    for second in range(8):
        pair.a.at = (pair.a.at, AT_TWIN)[second % 2]
        link(pair, pair.a, at + second)


def releases_after_a_restart(pair: Pair, at: float) -> None:
    """A confirmation of the process before: one handshake looks like another machine's, the next one does not."""
    for now in (at, at + 1):
        response = only(datagrams(pair.b.receive(initiation(pair.a, now), now), wire.RESPONSE))
        (confirmation,) = datagrams(pair.a.receive(response, now))
    pair.a = another_alpha(pair, 10 + round(at))
    link(pair, pair.a, at + 2)
    pair.b.receive(confirmation, at + 3)
    link(pair, pair.a, at + 4)
    link(pair, pair.a, at + 6)


@pytest.mark.parametrize(
    ("attack", "times"),
    [
        (withholds_confirmation, (1.0, 21.0)),
        (withholds_what_follows, (1.0, 21.0)),
        (delivers_an_old_initiation, (1.0, 21.0)),
        (replays_after_a_restart, (1.0, 21.0)),
        (forwards, (1.0, 21.0)),
        (releases_after_a_restart, (1.0, 2.0 + c.TWIN_PROOFS_WITHIN_S)),
    ],
)
def test_an_attacker_without_the_key_makes_no_twin(
    attack: Callable[[Pair, float], None], times: tuple[float, float]
) -> None:
    """Nor does the change of keys or the restart that follows, however often: one late datagram is once a minute."""
    pair = Pair().establish()
    for at in times:
        attack(pair, at)
        link(pair, pair.a, at + 12)
        link(pair, pair.a, at + 13)
    before, pair.a = pair.a, another_alpha(pair)
    link(pair, pair.a, times[1] + 14)
    link(pair, pair.a, times[1] + 15)
    assert twins(before, pair.a, pair.b) == [{}, {}, {}]
