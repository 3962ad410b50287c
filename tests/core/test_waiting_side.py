"""A side that leaves initiations to its peer, as a relay does with its members."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.core.harness import AT_A, Pair, datagrams
from tests.core.test_peer import initiations, stray
from uavlinkd.core.settings import Link


@pytest.fixture
def pair() -> Pair:
    """Beta knows where alpha is, and waits for it."""
    pair = Pair(link_b=Link())
    pair.b.peer.settings = replace(pair.b.peer.settings, initiates=False)
    pair.b.node.set_paths(pair.b.peer, [AT_A], 0.0)
    return pair


def test_it_never_initiates(pair: Pair) -> None:
    """Neither at first, nor when the session is old or the peer is lost, nor because of a hint."""
    assert initiations(pair.b.timeout(0.0)) == []
    assert datagrams(pair.b.receive(stray(), 0.01)) == []
    pair.establish(1.0)
    sent = [output for second in range(2, 1000) for output in pair.b.timeout(float(second))]
    assert datagrams(sent) != []
    assert initiations(sent) == []
    assert not pair.b.peer.is_up


def test_it_answers(pair: Pair) -> None:
    """Its peer makes the session, and another one when it is back."""
    pair.establish(1.0)
    assert pair.carries(1.0)
    for second in range(2, 1000):
        pair.b.timeout(float(second))
    pair.a.timeout(1000.0)
    pair.establish(1001.0)
    assert pair.carries(1001.0)
