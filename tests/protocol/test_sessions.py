"""The sessions of a peer, which of them sends, and the indices under which they are found."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from tests.protocol.harness import seeded
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.handshake import Keys
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.sessions import Indices, Sessions, Unconfirmed
from uavlinkd.protocol.suites import X25519
from uavlinkd.protocol.wire import Parameters

PATH = Path(0, ("192.0.2.1", 1))
OWNER = cast(Any, object())
QUARANTINE_S = c.INDEX_QUARANTINE_S


def session(index: int, generation: int = 1, *, initiator: bool = True) -> Session:
    """A session with this local index, from second 0 to second 180."""
    keys = Keys(X25519, (Secret(bytes(32)), Secret(bytes(32))), bytes(32), Parameters(generation, False, 16, 1232), 1)
    return Session(keys, index, 0.0, 180.0, is_initiator=initiator)


def unconfirmed(index: int, *, is_expected: bool = False) -> Unconfirmed:
    """A session that waits for its first envelope."""
    waiting = session(index, initiator=False)
    return Unconfirmed(waiting, bytes(16), 147, bytes(60), [PATH], is_expected, bytes(16), 10.0, b"")


@pytest.fixture
def sessions() -> Sessions:
    """The sessions of the side with the smaller key."""
    return Sessions(Indices[object](seeded(1)), "bravo", has_smaller_key=True)


def owners(sessions: Sessions) -> list[int]:
    """The indices that are in use."""
    return sorted([*sessions.unconfirmed, *(session.local_index for session in sessions.confirmed)])


def test_confirmed_sessions_are_bounded_and_ended_indices_quarantined(sessions: Sessions) -> None:
    """The lowest rank goes when there are too many, also a newcomer of low rank."""
    for generation in (3, 4, 5, 6, 7, 2):
        sessions.confirm(session(generation, generation), 0.0)
        assert len(sessions.confirmed) <= c.USABLE_PER_PEER
    assert owners(sessions) == [5, 6, 7]
    assert all(sessions._indices.is_quarantined(index, 0.0) for index in (2, 3, 4))


def test_waiting_sessions_are_bounded_and_the_oldest_of_its_kind_goes(sessions: Sessions) -> None:
    """Neither kind pushes out the other. A forgotten index is free at once."""
    sessions.wait(unconfirmed(1))
    sessions.wait(unconfirmed(2, is_expected=True))
    for index in range(3, c.UNCONFIRMED_PER_KIND + 10):
        sessions.wait(unconfirmed(index))
    assert list(sessions.unconfirmed) == owners(sessions) == [2, *range(10, 26)]
    assert not sessions._indices.is_quarantined(1, 0.0)
    for index in range(30, 30 + c.UNCONFIRMED_PER_KIND):
        sessions.wait(unconfirmed(index, is_expected=True))
    assert list(sessions.unconfirmed) == [*range(10, 26), *range(30, 46)]


# Indices.


def drawing(*values: int) -> Callable[[int], bytes]:
    """Entropy that gives these indices."""
    left = list(values)
    return lambda size: left.pop(0).to_bytes(size, "big")


def test_picked_index_is_neither_zero_nor_owned() -> None:
    """A pick alone does not take it. One that never carried a session needs no rest."""
    indices = Indices[object](drawing(0, 0, 5, 5, 5, 6, 5))
    assert [indices.pick(0.0), indices.pick(0.0)] == [5, 5]
    indices.owners[5] = OWNER
    assert indices.pick(0.0) == 6
    del indices.owners[5]
    assert not indices.is_quarantined(5, 0.0)
    assert indices.pick(0.0) == 5


def test_retired_index_is_quarantined_for_ten_minutes() -> None:
    """Each for its own time, and then it is forgotten: the quarantine does not grow."""
    indices = Indices[object](drawing(5, 6, 5, 7, 5, 8))
    indices.owners[5] = OWNER
    indices.retire(5, "bravo", 100.0)
    indices.retire(4, "bravo", 101.0)
    assert 5 not in indices.owners
    assert indices.pick(100.0) == 6
    assert indices.pick(100.0 + QUARANTINE_S - 0.001) == 7
    assert indices.is_quarantined(5, 100.0 + QUARANTINE_S - 0.001)
    assert not indices.is_quarantined(5, 100.0 + QUARANTINE_S)
    assert indices.pick(100.0 + QUARANTINE_S) == 5
    assert list(indices._quarantine) == [4]
    indices.pick(101.0 + QUARANTINE_S)
    assert not indices._quarantine


def test_a_peer_that_makes_many_sessions_uses_up_its_own_share() -> None:
    """The oldest of its indices are free again before their time; those of another peer rest."""
    indices, share = Indices[object](seeded(1)), c.QUARANTINED_PER_PEER
    indices.retire(60_000, "charlie", 0.0)
    for index in range(1, share + 3):
        indices.retire(index, "bravo", 1.0)
    assert [index for index in range(1, 2**16) if indices.is_quarantined(index, 2.0)] == [
        *range(3, share + 3),
        60_000,
    ]
    indices.pick(QUARANTINE_S + 1.0)
    assert indices._quarantine == {}
    assert indices._quarantined_of == {}
