"""The sessions of a peer, which of them sends, and the indices under which they are found."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, cast

import pytest

from tests.core.harness import seeded
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.handshake import Keys
from uavlinkd.core.path import Path
from uavlinkd.core.session import Session
from uavlinkd.core.sessions import Indices, Sessions, Unconfirmed
from uavlinkd.core.suites import X25519
from uavlinkd.core.wire import Parameters

PATH = Path(0, ("192.0.2.1", 1))
OWNER = cast(Any, object())
QUARANTINE_S = c.INDEX_QUARANTINE_S


def session(index: int, generation: int = 1, *, initiator: bool = True, now: float = 0.0) -> Session:
    """A session with this local index, rejected 180 s after ``now``."""
    keys = Keys(
        X25519, (Secret(bytes(32)), Secret(bytes(32))), bytes(32), Parameters(generation, False, 16, 256, 1232), 1
    )
    return Session(keys, index, now, 180.0, is_initiator=initiator)


def unconfirmed(index: int, expires_at: float = 10.0, *, is_expected: bool = False) -> Unconfirmed:
    """A session that waits for its first envelope."""
    waiting = session(index, initiator=False)
    return Unconfirmed(waiting, bytes(16), 147, bytes(60), [PATH], is_expected, bytes(16), expires_at)


def empty(*, has_smaller_key: bool = True) -> Sessions:
    """The sessions of one side."""
    return Sessions(Indices[object](seeded(1)), "bravo", has_smaller_key=has_smaller_key)


@pytest.fixture
def sessions() -> Sessions:
    """The sessions of the side with the smaller key."""
    return empty()


def owners(sessions: Sessions) -> list[int]:
    """The indices that are in use."""
    return sorted([*sessions.unconfirmed, *(session.local_index for session in sessions.confirmed)])


def test_the_newest_generation_sends() -> None:
    """Of confirmed sessions, in whatever order they came up, the one of the greatest generation sends."""
    for order in itertools.permutations((1, 2, 3)):
        sessions = empty()
        assert (sessions.current, sessions.generation, sessions.next_expiry()) == (None, 0, c.NEVER)
        for generation in order:
            sessions.confirm(session(generation, generation), 0.0)
        assert [other.parameters.generation for other in sessions.confirmed] == [3, 2, 1]
        assert sessions.generation == 3


@pytest.mark.parametrize("smaller", [True, False])
@pytest.mark.parametrize("own_first", [True, False])
def test_of_one_generation_the_smaller_keys_initiation_sends(smaller: bool, own_first: bool) -> None:
    """Both ends initiated at once: the session that the smaller key initiated sends, at either end, in any order."""
    sessions = empty(has_smaller_key=smaller)
    for initiated_here in (own_first, not own_first):
        sessions.confirm(session(1 + initiated_here, 5, initiator=initiated_here), 0.0)
    assert sessions.current is not None
    assert sessions.current.is_initiator == smaller


def test_of_equals_the_newest_sends(sessions: Sessions) -> None:
    """Where rank says nothing, the session confirmed last sends."""
    for index in (1, 2, 3):
        sessions.confirm(session(index, 2**32 - 1), 0.0)
        assert sessions.current is not None
        assert sessions.current.local_index == index


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


def test_sessions_expire_at_their_time(sessions: Sessions) -> None:
    """Not before. The next session takes over from a confirmed one."""
    sessions.wait(unconfirmed(8, 10.0))
    sessions.wait(unconfirmed(9, 11.0))
    sessions.confirm(session(1, 2, now=0.0), 0.0)
    sessions.confirm(session(2, 1, now=5.0), 5.0)
    for moment, left in ((10.0, [1, 2, 9]), (11.0, [1, 2]), (180.0, [2])):
        before = owners(sessions)
        assert sessions.next_expiry() == moment
        sessions.expire(moment - 0.001)
        assert owners(sessions) == before
        sessions.expire(moment)
        assert owners(sessions) == left
    assert sessions.generation == 1
    assert sessions._indices.is_quarantined(1, 180.0)


def test_close_ends_this_session_and_lower_ones(sessions: Sessions) -> None:
    """A close ends the session that carried it and those before it, not what came after. Clearing ends all."""
    kept = [session(generation, generation) for generation in (1, 2, 3)]
    for kept_session in kept:
        sessions.confirm(kept_session, 0.0)
    assert sessions.end_up_to(kept[1], 1.0) == [kept[1], kept[0]]
    assert sessions.confirmed == [kept[2]]
    sessions.wait(unconfirmed(4))
    sessions.clear(1.0)
    assert (sessions.confirmed, sessions.unconfirmed, sessions.current) == ([], {}, None)
    assert [sessions._indices.is_quarantined(index, 1.0) for index in (3, 4)] == [True, False]


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
    indices.forget(5)
    assert not indices.is_quarantined(5, 0.0)
    assert indices.pick(0.0) == 5
    indices.forget(5)  # without an owner: nothing happens


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


def test_no_index_is_picked_if_all_are_in_use() -> None:
    """Running out of indices is a drop, not an endless search. With half of them free, one is found."""
    indices = Indices[object](seeded(1))
    indices.owners.update(dict.fromkeys(range(1, 2**15), OWNER))
    assert all(indices.pick(0.0) >= 2**15 for _ in range(1000))
    indices.owners.update(dict.fromkeys(range(2**15, 2**16), OWNER))
    with pytest.raises(Drop) as caught:
        indices.pick(0.0)
    assert caught.value.reason is DropReason.NO_FREE_INDEX


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
