"""Paths along relays: which handles are ours, and data along them. uavlinkd/core/README.md, section 21."""

from __future__ import annotations

from collections.abc import Iterable

from uavlinkd.core.drops import DropReason
from uavlinkd.core.path import Path, SocketAddress, relayed
from uavlinkd.core.relay_records import RELAYED, handle_of, wrap
from uavlinkd.link.turns import WaitingDatagram

RELAYED_START = bytes((RELAYED,))
_HEADER_BYTES = 3


class RelayHandles:
    """The handles that relays assigned to this daemon, each on its path to the relay."""

    def __init__(self) -> None:
        self._inward: dict[tuple[int, SocketAddress, int], Path] = {}
        self._outward: dict[Path, tuple[SocketAddress, int]] = {}
        self._assigned: dict[tuple[str, Path], set[int]] = {}  # those that lead somewhere, by relay
        self._waiting: dict[tuple[str, Path], list[int]] = {}  # handles that another relay or address has, by relay

    def assign(self, relay: str, at: Path, handles: Iterable[int]) -> None:
        """These are all handles on the path ``at`` to the relay of this name from now on.

        A path to a relay is never relayed: whatever a relay sends, no datagram goes to a host that is not an address.
        A relay in the middle answers at the address of another relay. It must not end the handles of that one.
        A handle that both assign leads along the first one, and along the other one when that ends.
        """
        wanted = set[int]() if at.is_relayed else set(handles)
        own = self._assigned.pop((relay, at), set())
        for handle in own - wanted:
            del self._outward[self._inward.pop((at.socket, at.address, handle))]
        if kept := own & wanted:
            self._assigned[relay, at] = kept
        self._waiting.pop((relay, at), None)
        self._add(relay, at, wanted - kept)
        waiting, self._waiting = self._waiting, {}
        for (name, path), those in waiting.items():
            self._add(name, path, those)

    def _add(self, relay: str, at: Path, handles: Iterable[int]) -> None:
        for handle in handles:
            path, key = relayed(at.socket, relay, handle), (at.socket, at.address, handle)
            if path in self._outward or key in self._inward:  # a relay with two addresses, or two with one address
                self._waiting.setdefault((relay, at), []).append(handle)
            else:
                self._assigned.setdefault((relay, at), set()).add(handle)
                self._inward[key] = path
                self._outward[path] = at.address, handle

    def address_of(self, path: Path) -> SocketAddress | None:
        """The relay's address along a relayed path. None if its handle is gone, or it is another path."""
        known = self._outward.get(path)
        return None if known is None else known[0]

    def unwrap(self, socket: int, data: bytes, source: SocketAddress) -> WaitingDatagram | DropReason:
        """The datagram in data that begins with :data:`RELAYED_START`, and its relayed path; or why it is dropped."""
        handle = handle_of(data)
        if not handle:
            return DropReason.RELAY_MALFORMED
        path = self._inward.get((socket, source, handle))
        return DropReason.RELAY_UNKNOWN_HANDLE if path is None else (data[_HEADER_BYTES:], path)

    def wrap(self, datagram: bytes, path: Path) -> tuple[bytes, SocketAddress] | None:
        """What is sent instead of a datagram along a relayed path, and where. None if its handle is gone."""
        known = self._outward.get(path)
        if known is None:
            return None
        address, handle = known
        return wrap(handle, datagram), address
