"""One relay of this daemon: a peer of the core. uavlinkd/protocol/README.md, section 21.

It carries no frames, unless it is a peer of the configuration too: then one session serves both. It binds this
daemon's peers along each working path to the relay, and knows the handles that the relay assigned.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from uavlinkd.config.model import RelayConfig
from uavlinkd.daemon.features import WaitingDatagram
from uavlinkd.daemon.peer_link import PeerLink, Rates, silent_since
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.path import Path, SocketAddress, relayed
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.relay_records import (
    RELAYED_HEADER_BYTES,
    WAITING,
    Bind,
    Bound,
    binds_of,
    handle_of,
    wrap,
)
from uavlinkd.system.addresses import Address

BIND_SOON_S: Final = 0.1
"""The first bind is repeated after this: it may have come before the relay validated the path. Each further wait is
twice as long, up to ``BIND_RETRY_S``. On a slow path, or to a relay that is busy, after two round trips."""
ASK_S: Final = 0.25
"""A relay is asked this often at most along one socket."""


class RelayHandles:
    """The handles that relays assigned to this daemon, each on its path to the relay."""

    def __init__(self) -> None:
        self._inward: dict[tuple[int, SocketAddress, int], Path] = {}
        self._outward: dict[Path, tuple[SocketAddress, int]] = {}
        self._assigned: dict[tuple[str, Path], set[int]] = {}  # those that lead somewhere, by relay

    def assign(self, relay: str, at: Path, handles: Iterable[int]) -> None:
        """These are all handles on the path ``at`` to the relay of this name from now on.

        A path to a relay is never relayed: whatever a relay sends, no datagram goes to a host that is not an address.
        A relay in the middle answers at the address of another relay. It must not end the handles of that one. A
        handle that both assign leads along the first one. The other one gets it with a later record, if it is free.
        """
        wanted = set[int]() if at.is_relayed else set(handles)
        own = self._assigned.pop((relay, at), set())
        for handle in own - wanted:
            del self._outward[self._inward.pop((at.socket, at.address, handle))]
        kept = own & wanted
        for handle in wanted - kept:
            path, key = relayed(at.socket, relay, handle), (at.socket, at.address, handle)
            if path not in self._outward and key not in self._inward:
                kept.add(handle)
                self._inward[key] = path
                self._outward[path] = at.address, handle
        if kept:
            self._assigned[relay, at] = kept

    def unwrap(self, socket: int, data: bytes, source: SocketAddress) -> WaitingDatagram | DropReason:
        """The datagram in :data:`.RELAYED_START` data, and its relayed path; or why it is dropped."""
        handle = handle_of(data)
        if not handle:
            return DropReason.RELAY_MALFORMED
        path = self._inward.get((socket, source, handle))
        return DropReason.RELAY_UNKNOWN_HANDLE if path is None else (data[RELAYED_HEADER_BYTES:], path)

    def wrap(self, datagram: bytes, path: Path) -> tuple[bytes, SocketAddress] | None:
        """What is sent instead of a datagram along a relayed path, and where. None if its handle is gone."""
        known = self._outward.get(path)
        if known is None:
            return None
        address, handle = known
        return wrap(handle, datagram), address


@dataclass(slots=True, eq=False)
class _Binding:
    """What this daemon asked for along one path to the relay, and what it got."""

    at: Path
    due_at: float = -NEVER
    tries: int = 0
    """Binds since the last answer."""
    unanswered: frozenset[bytes] = frozenset()
    """The keys of the last bind that no record has named since."""
    handles: dict[bytes, tuple[int, ...]] = field(default_factory=dict)
    """By key of a peer; empty while the peer is not there."""
    orders: dict[bytes, int] = field(default_factory=dict)
    """By key of a peer: that of the last record about it."""
    bound_at: float = -NEVER
    """When the relay answered last."""
    seen_as: Address | None = None
    """This daemon's address as the relay sees it."""

    def note_sent(self, keys: Sequence[bytes], soon_s: float, now: float) -> None:
        """A bind was sent. Sets when the next one is due without an answer."""
        self.unanswered = frozenset(keys)
        self.due_at = now + min(c.BIND_RETRY_S, soon_s * 2.0 ** min(self.tries, 8))
        self.tries += 1

    def receive(self, bound: Bound, order: int, wanted: Iterable[bytes], now: float) -> set[bytes] | DropReason:
        """Take the handles of those peers that are wanted.

        Returns the keys whose handles changed, or why the record has no effect.
        """
        asked = {key for key, _ in bound.handles if key in wanted}
        named: dict[bytes, tuple[int, ...]] = {key: () for key in asked if order > self.orders.get(key, -1)}
        if not named:
            return DropReason.OLD_RECORD if asked else DropReason.UNEXPECTED_RECORD
        self.bound_at, self.seen_as = now, Address(bound.host, bound.port)
        for key, handle in bound.handles:
            if key in named and handle != WAITING and len(named[key]) < c.HANDLES_PER_PAIR:
                named[key] = (*named[key], handle)
        changed = set[bytes]()
        for key, handles in named.items():
            self.orders[key] = order
            if handles != self.handles.get(key, ()):
                changed.add(key)
            self.handles[key] = handles
        is_answer = bool(self.unanswered)
        self.unanswered -= named.keys()
        if not self.unanswered:
            self.tries = 0
            is_waiting = not all(self.handles.get(key) for key in wanted)
            due_at = now + (c.BIND_WAITING_S if is_waiting else c.BIND_INTERVAL_S)
            self.due_at = due_at if is_answer else min(self.due_at, due_at)  # reports about others put nothing off
        return changed


class RelayLink:
    """A relay of the configuration. Times are monotonic seconds. It sends in :meth:`do_due` only.

    ``on_handles`` is called with the keys of the peers whose handles changed. ``link``: the peer that it is too.
    Look at :attr:`next_at` after each call.
    """

    def __init__(
        self,
        config: RelayConfig,
        node: Node,
        handles: RelayHandles,
        on_handles: Callable[[set[bytes], float], None],
        now: float,
        link: PeerLink | None = None,
    ) -> None:
        self.config = config
        self.name = config.settings.name
        """No peer of the configuration has such a name."""
        self.link = link
        self.peer = node.add_peer(config.settings, now) if link is None else link.peer
        """Its object in the core."""
        self.rates = Rates(now)
        self.keys: tuple[bytes, ...] = ()
        """Of the peers that use it."""
        self.next_at = NEVER
        """When :meth:`do_due` has something to do."""
        self._expected_since = now
        self._node = node
        self._handles = handles
        self._on_handles = on_handles
        self._bindings: dict[Path, _Binding] = {}
        self._asks: set[int] = set()  # sockets
        self._failed: set[Path] = set()
        self._asked_at: dict[int, float] = {}

    @property
    def silent_since(self) -> float:
        """When something new came from it last, or the daemon began to expect it."""
        return silent_since(self.peer, self._expected_since)

    def views(self) -> list[tuple[Path, Address]]:
        """The paths to the relay by UDP, each with this daemon's address as the relay sees it there."""
        seen = ((path, binding.seen_as) for path, binding in self._bindings.items() if path.is_udp)
        return [(path, seen_as) for path, seen_as in seen if seen_as is not None]

    def works_along(self, path: Path) -> bool:
        """Whether the relay answers along a path now."""
        state = self.peer.paths.find(path)
        return self.peer.is_up and state is not None and state.works

    def state_for(self, link: PeerLink) -> str:
        """Whether a peer is reached along the relay: ``bound``, ``waiting`` for it to ask too, or ``unanswered``."""
        handles = [binding.handles[link.key] for binding in self._bindings.values() if link.key in binding.handles]
        return "bound" if any(handles) else "waiting" if handles and self.peer.is_up else "unanswered"

    def paths_to(self, key: bytes) -> list[list[Path]]:
        """The relayed paths to the peer with this key: a list for each path to the relay."""
        return [
            [relayed(at.socket, self.config.name, handle) for handle in binding.handles.get(key, ())]
            for at, binding in self._bindings.items()
        ]

    # What happens.

    def set_paths(self, paths: Sequence[Path], now: float) -> None:
        """The relay is reached along these paths."""
        self._node.set_paths(self.peer, paths, now)
        self._forget_lost(now)

    def follow(self, keys: Sequence[bytes]) -> None:
        """Bind these peers from now on."""
        before, self.keys = set(self.keys), tuple(keys)
        for binding in self._bindings.values():
            for key in before - set(keys):
                binding.handles.pop(key, None)
            self._assign(binding)
            if set(keys) - before:
                self._hurry(binding)
        self._schedule()

    def on_event(self, event: o.Event, now: float) -> None:
        """A path works, or a session began, perhaps because the relay was restarted: bind immediately."""
        if isinstance(event, o.PeerClosed):
            self._expected_since = now
        for path, binding in self._bindings.items():
            if isinstance(event, o.SessionEstablished) or (
                isinstance(event, o.PathStateChanged) and event.is_usable and event.path == path
            ):
                self._hurry(binding)
        self._forget_lost(now)
        self._schedule()

    def on_record(self, received: o.RecordReceived, now: float) -> DropReason | None:
        """The relay assigned handles. Returns why that has no effect; None if it has one."""
        binding = self._bindings.get(received.path)
        if binding is None or not isinstance(received.record, Bound):
            return DropReason.UNEXPECTED_RECORD  # a path without a bind; a bind, which is for a relay
        changed = binding.receive(received.record, received.order, self.keys, now)
        if isinstance(changed, DropReason):
            return changed
        if changed:
            self._assign(binding)
            self._on_handles(changed, now)
        self._schedule()
        return None

    def ask(self, path: Path, *, binds: bool = True) -> None:
        """A path along the relay failed: ask the relay on its socket, and bind again, as soon as possible.

        The relay may answer although it forwards nothing: a NAT has given this daemon another address there.
        ``binds``: False if that was done since the failure.
        """
        self._asks.add(path.socket)
        if binds:
            self._failed.add(path)
        self._schedule()

    def on_unknown_handle(self, at: Path, now: float) -> None:
        """Data came with a handle that this daemon does not know: a bound record may be lost, so bind again.

        An attacker can send such data too. It causes one record each :data:`ASK_S`, and none before an answer.
        """
        binding, records = self._bindings.get(at), -(-len(self.keys) // c.KEYS_PER_BIND)
        if binding is not None and not binding.unanswered and now >= binding.bound_at + ASK_S * records:
            self._hurry(binding)
            self._schedule()

    def do_due(self, now: float) -> list[o.Output]:
        """Ask and bind. Call it at :attr:`next_at`."""
        out: list[o.Output] = []
        # What was asked a moment ago may have been answered before the path failed: ask again, a little later.
        sockets = {socket for socket in self._asks if now >= self._ask_at(socket)}
        failed = {path for path in self._failed if path.socket in sockets}
        self._asks -= sockets
        self._failed -= failed
        self._asked_at |= dict.fromkeys(sockets, now)
        for path in [state.path for state in self._states() if state.path.socket in sockets]:
            # The bind is longer than a question: the relay may ask a new address of this daemon at once.
            if keys := self._keys_of(failed, path)[: c.KEYS_PER_BIND]:
                out += self._node.send_record(self.peer, path, Bind(keys), now)
            out += self._node.ask(self.peer, path, now)
        for binding in self._working():
            if now >= binding.due_at and self.keys:
                binding.note_sent(self.keys, max(BIND_SOON_S, c.ECHO_ROUND_TRIPS * self.peer.answer_s), now)
                for bind in binds_of(self.keys):
                    out += self._node.send_record(self.peer, binding.at, bind, now)
        self._schedule()
        return out

    def do_housekeeping(self, now: float) -> None:
        """Call it about once a second."""
        self.rates.measure(self.peer, now)
        self._forget_lost(now)
        self._schedule()

    def leave(self, now: float) -> list[o.Output]:
        """Forget its handles, and end the session unless it is a peer's."""
        changed = set(self.keys)
        self.keys = ()
        for path in list(self._bindings):
            self._forget(path)
        self._on_handles(changed, now)
        return [] if self.link is not None else self._node.remove_peer(self.peer, now)

    # Parts.

    def _states(self) -> Iterator[PathState]:
        """The paths to it over IP, by UDP or TLS."""
        return (state for state in self.peer.paths.states if state.path.is_udp or state.path.is_web)

    def _working(self) -> Iterator[_Binding]:
        for state in self._states():
            if state.works and self.peer.is_up:
                yield self._bindings.setdefault(state.path, _Binding(state.path))

    def _keys_of(self, paths: Collection[Path], at: Path) -> tuple[bytes, ...]:
        """Of the peers to which these lead by handles on a path to the relay."""
        handles = self._bindings[at].handles if at in self._bindings else {}
        return tuple(
            key for key, own in handles.items() if any(relayed(at.socket, self.config.name, h) in paths for h in own)
        )

    def _hurry(self, binding: _Binding) -> None:
        """Bind as soon as possible. An answer to the bind before does not put this off."""
        binding.due_at, binding.tries, binding.unanswered = -NEVER, 0, frozenset(self.keys)

    def _assign(self, binding: _Binding) -> None:
        handles = [handle for of_key in binding.handles.values() for handle in of_key]
        self._handles.assign(self.config.name, binding.at, handles)

    def _forget_lost(self, now: float) -> None:
        """Forget the handles on paths that are gone, or along which the relay has not answered for long."""
        changed = set[bytes]()
        for path, binding in list(self._bindings.items()):
            is_old = now >= binding.bound_at + c.BIND_LIFETIME_S and any(binding.handles.values())
            if is_old or self.peer.paths.find(path) is None:
                changed |= binding.handles.keys()
                self._forget(path)
        if changed:
            self._on_handles(changed, now)

    def _forget(self, path: Path) -> None:
        del self._bindings[path]
        self._handles.assign(self.config.name, path, ())

    def _schedule(self) -> None:
        due_at = min((binding.due_at for binding in self._working()), default=NEVER) if self.keys else NEVER
        self.next_at = min((due_at, *map(self._ask_at, self._asks)))

    def _ask_at(self, socket: int) -> float:
        return self._asked_at.get(socket, -NEVER) + ASK_S
