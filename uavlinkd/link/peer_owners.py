"""Peers of the core that carry no frames: the relays of this daemon, and the members of a relay."""

from __future__ import annotations

from typing import Protocol

from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Event, RecordReceived


class PeerOwner(Protocol):
    """What such a peer of the core belongs to. Frames from it are dropped, whatever a policy says.

    Both methods are called while the core's outputs are performed, so neither may send: it notes what is due.
    """

    def on_event(self, event: Event, now: float) -> None:
        """An event of the peer."""

    def on_record(self, received: RecordReceived, now: float) -> DropReason | None:
        """A record came from the peer. Returns why it has no effect; None if it has one."""
