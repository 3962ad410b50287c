"""Session indices: unpredictable, unique, and left alone for a while after use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from tests.core.harness import seeded
from uavlinkd.core.constants import INDEX_QUARANTINE_S, QUARANTINED_PER_PEER
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.indices import Indices

OWNER = cast(Any, object())


def drawing(*values: int) -> Callable[[int], bytes]:
    """Entropy that gives these indices."""
    left = list(values)
    return lambda size: left.pop(0).to_bytes(size, "big")


def test_zero_is_never_picked() -> None:
    """Index 0 is reserved."""
    assert Indices(drawing(0, 0, 5)).pick(0.0) == 5


def test_owned_index_is_not_picked() -> None:
    """No two sessions have one index; a pick alone does not take it."""
    indices = Indices[object](drawing(5, 5, 5, 6))
    assert indices.pick(0.0) == 5
    assert indices.pick(0.0) == 5
    indices.owners[5] = OWNER

    assert indices.pick(0.0) == 6


def test_retired_index_is_quarantined_for_ten_minutes() -> None:
    """An index that carried a session is not picked again until just ten minutes later."""
    indices = Indices[object](drawing(5, 6, 5, 7, 5))
    indices.owners[5] = OWNER
    indices.retire(5, "bravo", 100.0)

    assert 5 not in indices.owners
    assert indices.pick(100.0) == 6
    assert indices.pick(100.0 + INDEX_QUARANTINE_S - 0.001) == 7
    assert indices.is_quarantined(5, 100.0 + INDEX_QUARANTINE_S - 0.001)
    assert not indices.is_quarantined(5, 100.0 + INDEX_QUARANTINE_S)
    assert indices.pick(100.0 + INDEX_QUARANTINE_S) == 5
    assert INDEX_QUARANTINE_S == 600.0


def test_quarantine_is_released_in_order() -> None:
    """Each index is free when its own time is over, and is then forgotten: the quarantine does not grow."""
    indices = Indices[object](seeded(1))
    for index in (3, 7, 9):
        indices.retire(index, "bravo", float(index))

    indices.pick(INDEX_QUARANTINE_S + 7.0)
    assert list(indices._quarantine) == [9]
    indices.pick(INDEX_QUARANTINE_S + 9.0)
    assert not indices._quarantine


def test_forgotten_index_is_free_at_once() -> None:
    """An index that never carried a session needs no rest."""
    indices = Indices[object](drawing(5))
    indices.owners[5] = OWNER
    indices.forget(5)

    assert not indices.is_quarantined(5, 0.0)
    assert indices.pick(0.0) == 5
    indices.forget(5)  # without an owner: nothing happens


def test_no_index_is_picked_if_all_are_in_use() -> None:
    """Running out of indices is a drop, not an endless search, and the last free one is not needed to see it."""
    indices = Indices[object](seeded(1))
    indices.owners.update(dict.fromkeys(range(1, 2**16), OWNER))

    with pytest.raises(Drop) as caught:
        indices.pick(0.0)
    assert caught.value.reason is DropReason.NO_FREE_INDEX


def test_indices_are_found_while_half_are_taken() -> None:
    """With half of all indices in use a free one is found as good as always."""
    indices = Indices[object](seeded(1))
    indices.owners.update(dict.fromkeys(range(1, 2**15), OWNER))

    for _ in range(1000):
        assert indices.pick(0.0) >= 2**15


def test_a_peer_that_makes_many_sessions_uses_up_its_own_share() -> None:
    """The oldest of its indices are free again before their time; those of another peer rest."""
    indices = Indices[object](seeded(1))
    indices.retire(60_000, "charlie", 0.0)
    for index in range(1, QUARANTINED_PER_PEER + 3):
        indices.retire(index, "bravo", 1.0)

    quarantined = [index for index in range(1, 2**16) if indices.is_quarantined(index, 2.0)]
    assert quarantined == [*range(3, QUARANTINED_PER_PEER + 3), 60_000]
    indices.pick(INDEX_QUARANTINE_S + 1.0)
    assert indices._quarantine == {}
    assert indices._quarantined_of == {}
