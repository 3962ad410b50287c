"""Waiting a moment for company: the same as an Egress without a budget does, for less."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.mavlink.egress.samples import MAKERS, attitude, heartbeat, parameter
from uavlinkd.mavlink.egress.budgeted import Egress, EgressSettings, EnvelopeShape
from uavlinkd.mavlink.egress.coalescing import Coalescer
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import Frame

SETTINGS = EgressSettings(coalesce_s=0.1, max_age_s=1.0)


def sent_by(
    egress: Egress | Coalescer, puts: Sequence[tuple[float, Sequence[Frame]]]
) -> list[tuple[float, list[Frame]]]:
    """Each envelope, and when it went, if it is asked whenever frames come and whenever it says so."""
    sent: list[tuple[float, list[Frame]]] = []

    def take(now: float) -> None:
        while batch := egress.take(now):
            sent.append((now, batch))

    for now, frames in [*puts, (inf, [])]:
        while (due := egress.next_deadline()) < now:
            take(due)
        if frames:
            egress.put(frames, now)
            take(now)
    return sent


@given(
    st.lists(
        st.tuples(st.integers(0, 200), st.lists(st.integers(0, len(MAKERS) - 1), max_size=8)), min_size=1, max_size=30
    ),
    st.sampled_from([60, 300, 1200]),
)
def test_sends_what_an_egress_without_a_budget_sends(gaps: list[tuple[int, list[int]]], payload_limit: int) -> None:
    """The same frames, in the same order, in the same envelopes, at the same times."""
    puts, now, number = [], 0.0, 0
    for gap_ms, makers in gaps:
        now += gap_ms / 1000
        frames = [MAKERS[maker](number := number + 1) for maker in makers]
        puts.append((now, frames))
    shape = EnvelopeShape(payload_limit=payload_limit)
    coalescer, egress = Coalescer(SETTINGS), Egress(SETTINGS, 0.0, shape)
    coalescer.shape = shape
    assert sent_by(coalescer, puts) == sent_by(egress, puts)
    assert (coalescer.queued_frames, coalescer.queued_bytes) == (0, 0)
    assert coalescer.totals == egress.totals == {}


@pytest.mark.parametrize(("taken_at", "sent"), [(1.0, 1), (1.001, 0)])
def test_nothing_stale_is_sent(taken_at: float, sent: int) -> None:
    """A frame leaves at max_age_s exactly, and is dropped as stale just after."""
    coalescer = Coalescer(SETTINGS)
    coalescer.put([attitude(1)], 0.0)
    assert len(coalescer.take(taken_at)) == sent
    assert coalescer.totals == ({} if sent else {EgressDrop.STALE: 1})


def test_what_is_fresh_is_not_dropped_with_what_is_stale() -> None:
    """After a pause of the process a new command is put beside an old attitude: it leaves, the old one does not."""
    coalescer = Coalescer(SETTINGS)
    coalescer.put([attitude(1)], 0.0)
    coalescer.put([heartbeat(2)], 1.5)
    assert coalescer.take(1.5) == [heartbeat(2)]
    assert coalescer.totals == {EgressDrop.STALE: 1}


def test_clear_drops_all_that_waits() -> None:
    """Once a peer is gone nothing of it waits, and all is counted."""
    coalescer = Coalescer(SETTINGS)
    coalescer.put([attitude(1), parameter(1)], 0.0)
    coalescer.clear(0.05)
    assert (coalescer.queued_frames, coalescer.queued_bytes, coalescer.next_deadline()) == (0, 0, inf)
    assert coalescer.totals == {EgressDrop.CLOSED: 2}
    assert coalescer.take(0.2) == []
