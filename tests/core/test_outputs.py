"""What the core hands to the shell."""

from __future__ import annotations

from typing import get_args

from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Deliver, Dropped, Event, Output, RecordReceived, Transmit


def test_drop_is_one_datagram_without_a_peer_by_default() -> None:
    """By default a drop counts one datagram and names no peer."""
    assert Dropped(DropReason.MALFORMED) == Dropped(DropReason.MALFORMED, None, None, 1)


def test_events_are_the_outputs_that_move_no_bytes() -> None:
    """A shell that handles Transmit, Deliver, RecordReceived, Dropped and Event has handled every output."""
    assert set(get_args(Output)) == {Transmit, Deliver, RecordReceived, Dropped, *get_args(Event)}


def test_outputs_cannot_be_altered() -> None:
    """An output is a tuple: who keeps it keeps what was said then."""
    assert all(issubclass(kind, tuple) for kind in get_args(Output))
