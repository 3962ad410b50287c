"""Next, current and previous sessions, and which of them sends."""

from __future__ import annotations

import itertools

import pytest

from tests.core.harness import seeded
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret
from uavlinkd.core.handshake import Keys
from uavlinkd.core.indices import Indices
from uavlinkd.core.path import Path
from uavlinkd.core.session import Session
from uavlinkd.core.sessions import Sessions, Unconfirmed
from uavlinkd.core.suites import X25519
from uavlinkd.core.wire import Parameters

PATH = Path(0, ("192.0.2.1", 1))


def session(index: int, generation: int = 1, *, initiator: bool = True, now: float = 0.0) -> Session:
    """A session with this local index, rejected 180 s after ``now``."""
    keys = Keys((Secret(bytes(32)), Secret(bytes(32))), bytes(32), Parameters(generation, False, 16, 256, 1232), 1)
    return Session(X25519, keys, index, now, 180.0, is_initiator=initiator)


def unconfirmed(index: int, expires_at: float = 10.0, *, is_expected: bool = False) -> Unconfirmed:
    """A session that waits for its first envelope."""
    waiting = session(index, initiator=False)
    return Unconfirmed(waiting, bytes(16), 147, bytes(60), [PATH], is_expected, bytes(16), expires_at)


@pytest.fixture
def sessions() -> Sessions:
    """The sessions of the side with the smaller key."""
    return Sessions(Indices[object](seeded(1)), "bravo", has_smaller_key=True)


def owners(sessions: Sessions) -> list[int]:
    """The indices that are in use."""
    return sorted([*sessions.unconfirmed, *(session.local_index for session in sessions.confirmed)])


def test_without_a_session_there_is_nothing_to_send_on(sessions: Sessions) -> None:
    """At first there is no session, of generation 0, and nothing expires."""
    assert sessions.current is None
    assert sessions.generation == 0
    assert sessions.next_expiry() == float("inf")


def test_the_newest_generation_sends() -> None:
    """Of confirmed sessions, in whatever order they came up, the one of the greatest generation sends."""
    for order in itertools.permutations((1, 2, 3)):
        sessions = Sessions(Indices[object](seeded(1)), "bravo", has_smaller_key=True)
        for generation in order:
            sessions.confirm(session(generation, generation), 0.0)
        assert [other.parameters.generation for other in sessions.confirmed] == [3, 2, 1]
        assert sessions.generation == 3


@pytest.mark.parametrize("smaller", [True, False])
@pytest.mark.parametrize("own_first", [True, False])
def test_of_one_generation_the_smaller_keys_initiation_sends(smaller: bool, own_first: bool) -> None:
    """Both ends initiated at once: the session that the smaller key initiated sends, at either end, in any order."""
    sessions = Sessions(Indices[object](seeded(1)), "bravo", has_smaller_key=smaller)
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
    """The lowest rank goes when there are too many, and its index goes into quarantine."""
    for generation in range(1, c.USABLE_PER_PEER + 3):
        sessions.confirm(session(generation, generation), 0.0)
        assert len(sessions.confirmed) <= c.USABLE_PER_PEER

    assert owners(sessions) == [3, 4, 5]
    assert all(sessions._indices.is_quarantined(index, 0.0) for index in (1, 2))


def test_newcomer_of_low_rank_may_be_ended_at_once(sessions: Sessions) -> None:
    """A session that is older than all that are kept does not push a better one out."""
    for generation in (5, 6, 7, 4):
        sessions.confirm(session(generation, generation), 0.0)

    assert owners(sessions) == [5, 6, 7]


def test_waiting_sessions_are_bounded_and_the_oldest_goes(sessions: Sessions) -> None:
    """The sixteen newest wait; the index of a forgotten one is free at once."""
    for index in range(1, c.UNCONFIRMED_PER_PEER + 3):
        sessions.wait(unconfirmed(index))

    assert list(sessions.unconfirmed) == list(range(3, 19))
    assert owners(sessions) == list(range(3, 19))
    assert not sessions._indices.is_quarantined(1, 0.0)


def test_initiator_at_its_own_address_keeps_its_place(sessions: Sessions) -> None:
    """Calls from elsewhere, such as replayed ones, do not push out one from the peer's own place."""
    sessions.wait(unconfirmed(1))
    sessions.wait(unconfirmed(2, is_expected=True))
    for index in range(3, c.UNCONFIRMED_PER_PEER + 10):
        sessions.wait(unconfirmed(index))
    assert list(sessions.unconfirmed) == [2, *range(11, 26)]
    for index in range(30, 30 + c.UNCONFIRMED_PER_PEER):
        sessions.wait(unconfirmed(index, is_expected=True))
    assert list(sessions.unconfirmed) == list(range(30, 46))


def test_waiting_session_expires(sessions: Sessions) -> None:
    """An unconfirmed session is forgotten at the end of its lifetime and not before."""
    sessions.wait(unconfirmed(1, 10.0))
    sessions.wait(unconfirmed(2, 11.0))

    assert sessions.next_expiry() == 10.0
    sessions.expire(9.999)
    assert owners(sessions) == [1, 2]
    sessions.expire(10.0)
    assert owners(sessions) == [2]


def test_confirmed_session_expires(sessions: Sessions) -> None:
    """Keys are dropped at their time and not before, and the next session takes over."""
    sessions.confirm(session(1, 2, now=0.0), 0.0)
    sessions.confirm(session(2, 1, now=5.0), 5.0)

    assert sessions.next_expiry() == 180.0
    sessions.expire(179.999)
    assert owners(sessions) == [1, 2]
    sessions.expire(180.0)
    assert owners(sessions) == [2]
    assert sessions.generation == 1
    assert sessions._indices.is_quarantined(1, 180.0)


def test_close_ends_this_session_and_lower_ones(sessions: Sessions) -> None:
    """A close ends the session that carried it and those before it, not what came after."""
    kept = [session(generation, generation) for generation in (1, 2, 3)]
    for kept_session in kept:
        sessions.confirm(kept_session, 0.0)

    sessions.end_up_to(kept[1], 1.0)

    assert sessions.confirmed == [kept[2]]
    assert owners(sessions) == [3]


def test_clear_drops_every_key(sessions: Sessions) -> None:
    """Afterwards no index has an owner; those that carried a session rest."""
    sessions.wait(unconfirmed(1))
    sessions.confirm(session(2), 0.0)
    sessions.confirm(session(3), 0.0)

    sessions.clear(1.0)

    assert (sessions.confirmed, sessions.unconfirmed, owners(sessions)) == ([], {}, [])
    assert [sessions._indices.is_quarantined(index, 1.0) for index in (1, 2, 3)] == [False, True, True]
