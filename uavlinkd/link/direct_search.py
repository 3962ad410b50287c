"""The search for direct paths to one peer that is reached along a relay. uavlinkd/core/README.md, section 22.

Both ends name their candidates in their session, and ask those of the other one at the same time.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.drops import DropReason
from uavlinkd.core.limits import TokenBucket
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Event, Output, PathStateChanged, RecordReceived, SessionEstablished
from uavlinkd.core.path_state import PathCondition
from uavlinkd.core.peer import Peer
from uavlinkd.core.relay_records import Candidates
from uavlinkd.link.candidates import OwnSocket, Place, paths_to

LISTS: Final = 20
LISTS_PER_S: Final = 0.2
"""Lists of candidates that the peer gets at most, whatever a relay or the peer says: first so many, then so many a
second."""


class DirectSearch:
    """Names candidates to one peer, and asks its candidates. Times are monotonic seconds."""

    def __init__(self, node: Node, peer: Peer, now: float) -> None:
        self._node = node
        self._peer = peer
        self._own: tuple[Place, ...] = ()
        self._sockets: Sequence[OwnSocket] = ()
        self._relays: Collection[Place] = ()
        self._theirs: tuple[Place, ...] = ()
        self._order = -1
        self._tries = 0
        self._lists = TokenBucket(LISTS_PER_S, LISTS, now)
        self.next_at = NEVER
        """When :meth:`do_due` has something to do."""

    @property
    def theirs(self) -> tuple[Place, ...]:
        """The candidates that the peer named last."""
        return self._theirs

    def set_own(
        self, places: tuple[Place, ...], sockets: Sequence[OwnSocket], relays: Collection[Place], now: float
    ) -> None:
        """This daemon's candidates and sockets, and where relays are. Call it once a second, or after a change."""
        self._sockets, self._relays = sockets, relays
        if places != self._own:
            self._own = places
            self.begin(now)

    def begin(self, now: float) -> None:
        """Try again from the beginning."""
        self._tries = 0
        self.next_at = now

    def on_event(self, event: Event, now: float) -> None:
        """A session began, a relayed path works, or a direct one failed: begin again."""
        if isinstance(event, SessionEstablished) or (
            isinstance(event, PathStateChanged) and event.is_usable == event.path.is_relayed
        ):
            self.begin(now)

    def on_record(self, received: RecordReceived, now: float) -> DropReason | None:
        """The peer named its candidates. Returns why that has no effect; None if it has one."""
        if not isinstance(received.record, Candidates) or not received.path.is_relayed:
            return DropReason.UNEXPECTED_RECORD
        if received.order <= self._order:
            return DropReason.OLD_RECORD
        self._order = received.order
        if received.record.places != self._theirs:
            self._theirs = received.record.places
            self.begin(now)
        return None

    def do_due(self, now: float) -> list[Output]:
        """Name the own candidates along a relay, and ask those of the peer. Call it at :attr:`next_at`."""
        states = self._peer.paths.states
        best = self._peer.paths.best
        relayed = [state for state in states if state.path.is_relayed and (state.works or state is best)]
        if not relayed:
            self.next_at = NEVER  # until a relayed path works
            return []
        connected = {
            state.path.socket
            for state in states
            if not state.path.is_relayed and state.condition is PathCondition.USABLE
        }
        sockets = [socket for socket in self._sockets if socket.number not in connected]
        hosts = {host for socket in self._sockets for host, _ in socket.places}
        self._node.set_candidates(self._peer, paths_to(self._theirs, sockets, self._relays, hosts))
        out: list[Output] = []
        if self._own and (sockets or self._tries < c.CANDIDATE_TRIES) and self._lists.take(now):
            named = min(relayed, key=lambda state: state.srtt_s or NEVER)
            out += self._node.send_record(self._peer, named.path, Candidates(self._own), now)
        out += self._node.ask_candidates(self._peer, now)
        self.next_at = now + self._wait_s()
        self._tries += 1
        return out

    def _wait_s(self) -> float:
        """How long until the next questions."""
        later = self._tries - c.CANDIDATE_TRIES + 1
        if later < 0:
            return min(c.CANDIDATE_TRY_S * 2.0**self._tries, c.CANDIDATE_TRY_MOST_S)
        return min(c.CANDIDATE_ROUND_S * 2.0 ** min(later, 8), c.CANDIDATE_ROUND_MOST_S)
