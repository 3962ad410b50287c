"""What relays, and members of this daemon's own relay, send: datagrams that the core cannot read, and records."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import LinkedPeer, RecordReceived
from uavlinkd.core.path import Path, SocketAddress
from uavlinkd.core.relay_records import Candidates, FilterTested
from uavlinkd.link.filter_tests import TOKEN_START
from uavlinkd.link.intake import Take
from uavlinkd.link.peer_owners import PeerOwner
from uavlinkd.link.relay_handles import RELAYED_START
from uavlinkd.link.relays import Relays
from uavlinkd.link.turns import WaitingDatagram
from uavlinkd.relay.service import RelayService


class OnDropped(Protocol):
    """Counts a datagram of a peer, if its name is known, that came along a path."""

    def __call__(self, reason: DropReason, name: str = "", path: Path | None = None) -> None: ...


class FromRelays:
    """Passes datagrams and records to the part that they are for."""

    def __init__(
        self,
        relays: Relays,
        relay: RelayService | None,
        owners: Mapping[LinkedPeer, PeerOwner],
        on_dropped: OnDropped,
    ) -> None:
        self._relays = relays
        self._relay = relay
        self._owners = owners
        self._on_dropped = on_dropped

    @property
    def takers(self) -> dict[bytes, Take]:
        """The receivers of datagrams, by first byte; empty if this daemon neither uses relays nor is one."""
        if self._relays.by_name:
            return {RELAYED_START: self._take_relayed, TOKEN_START: self._take_token}
        return {} if self._relay is None else {RELAYED_START: self._relay.take}

    def on_record(self, received: RecordReceived, now: float) -> None:
        """A record came from a peer, a relay or a member."""
        owner = self._owners.get(received.peer)
        if isinstance(received.record, Candidates | FilterTested):
            reason = self._relays.on_record(received, now)
        else:
            reason = DropReason.UNEXPECTED_RECORD if owner is None else owner.on_record(received, now)
        if reason is not None:
            self._on_dropped(reason, received.peer.name, received.path)

    def _take_relayed(self, socket: int, data: bytes, source: SocketAddress) -> WaitingDatagram | None:
        taken = self._relays.handles.unwrap(socket, data, source)
        if isinstance(taken, DropReason):
            if self._relay is not None:  # of a member of this daemon
                self._relay.take(socket, data, source)
            else:
                self._on_dropped(taken, path=Path(socket, source))
            return None
        return taken

    def _take_token(self, socket: int, data: bytes, source: SocketAddress) -> None:
        path = Path(socket, source)
        if not self._relays.filter_tests.take_token(data, path):
            self._on_dropped(DropReason.RELAY_UNEXPECTED_TOKEN, path=path)
