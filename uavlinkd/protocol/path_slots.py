"""The slots of the paths to one peer: which paths are configured, learned, and known. README.md, section 15."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from operator import add
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.path import Path, SocketAddress, SocketFacts
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.session import Session


class Totals(NamedTuple):
    """The datagrams along all paths to one peer: envelopes, copies too, and handshake messages."""

    datagrams_sent: int
    bytes_sent: int
    bytes_received: int


Route = tuple[PathState, ...]
"""The paths along which one envelope goes, the best first."""


class Outlet(NamedTuple):
    """How the next frame of a stream leaves along the only path: decided once, for as long as nothing changes."""

    session: Session
    route: Route
    limit: int
    """The longest payload, in bytes."""
    until: float
    """When the session is too old."""


class PathSlots:
    """Slots for configured and for learned paths.

    ``known``: how many peers have proved to be at an address. It and ``facts`` are shared by all peers of a node.
    """

    def __init__(self, known: Counter[SocketAddress], facts: SocketFacts) -> None:
        self._known = known
        self.facts = facts
        """Behind the sockets of the paths."""
        self.by_path: dict[Path, PathState] = {}
        """The slots in use: the configured paths first, then the oldest."""
        self.best: PathState | None = None
        """Where frames go; a path that failed stays the best while there is no other."""
        self._departed = Totals(0, 0, 0)
        self.inlet: tuple[Path | None, PathState | None] = None, None
        """The path along which the last envelope came, and its slot: the next one costs no look-up."""
        self.outlet: Outlet | None = None
        """None where :func:`.send_frames` must decide: about classes, questions, long frames, the probe's timer."""
        self.unproven = 0
        """Learned paths that were given up because they answered nothing; it only grows."""
        self.candidates: tuple[Path, ...] = ()
        """Paths without a slot that may be asked: the peer says that it may be there."""
        self._asked: dict[Path, PathState] = {}  # those of them that were asked, to know their answers

    @property
    def states(self) -> list[PathState]:
        """Every slot in use, the configured paths first."""
        return list(self.by_path.values())

    @property
    def totals(self) -> Totals:
        """What went along these paths, to candidates, and along the paths that there were before. It only grows."""
        rows = [_totals_of(state) for state in (*self.by_path.values(), *self._asked.values())]
        return Totals(*map(sum, zip(self._departed, *rows, strict=True)))

    @property
    def has_several(self) -> bool:
        """Whether there is more than one path, whatever their condition."""
        return len(self.by_path) > 1

    @property
    def configured(self) -> tuple[Path, ...]:
        """The paths of the configuration."""
        return tuple(state.path for state in self.by_path.values() if state.is_configured)

    def find(self, path: Path) -> PathState | None:
        """The slot of a path."""
        return self.by_path.get(path)

    def with_number(self, number: int) -> PathState | None:
        """The slot with this number."""
        return next((state for state in self.by_path.values() if state.number == number), None)

    def configure(self, paths: Iterable[Path], now: float) -> None:
        """The paths of the configuration, the likeliest first. One that works stays, as a learned path.

        A relayed one does not stay: its handle leads nowhere any more.
        """
        hosts = Counter[tuple[int, str]]()
        wanted: list[Path] = []
        for path in dict.fromkeys(paths):
            hosts[path.socket, path.host] += 1
            if hosts[path.socket, path.host] <= c.PATHS_PER_HOST and len(wanted) < c.CONFIGURED_PATHS:
                wanted.append(path)
        before = self.by_path
        self._forget_ready()
        if any(path.is_relayed and path not in before for path in wanted):  # the peer may have another address
            for state in before.values():
                least_s = c.PROBE_INTERVAL_S if state.is_metered and state is not self.best else c.PROBE_FAST_S
                if now >= state.questioned_at + max(least_s, self.facts.least_probe_s(state.path)):
                    state.questioned_at = -c.NEVER  # ask at once
        self.by_path = {}
        for path in wanted:
            self.by_path[path] = before.get(path) or self._new(path, now, is_configured=True, others=before)
            self.by_path[path].is_configured = self.by_path[path].is_proven = True
        for path, state in before.items():
            if path not in self.by_path:
                if not path.is_relayed and (state is self.best or state.works):
                    state.is_configured = False
                    self.by_path[path] = state
                else:
                    self._drop(state)
                    if state is self.best:
                        self.best = self._successor(before)

    def _successor(self, before: Mapping[Path, PathState]) -> PathState | None:
        """A handle that came with the end of the best path's takes its place: frames need not wait for an answer."""
        new = (state for path, state in self.by_path.items() if path.is_relayed and path not in before)
        return None if any(state.works for state in self.by_path.values()) else next(new, None)

    def set_candidates(self, paths: Iterable[Path]) -> None:
        """The peer may be there too. The first :data:`c.CANDIDATES` count."""
        self.candidates = tuple(dict.fromkeys(paths))[: c.CANDIDATES]
        for path in self._asked.keys() - set(self.candidates):
            self._forget_asked(path)

    def to_ask(self, now: float) -> list[PathState]:
        """The candidates without a slot. They need not have sent anything, so questions are limited elsewhere."""
        for path in self.candidates:
            if path in self.by_path:
                self._forget_asked(path)
            elif path not in self._asked:
                state = self._asked[path] = PathState(path, 0, now, is_configured=False, is_metered=False)
                state.is_proven = True
        return list(self._asked.values())

    def _forget_asked(self, path: Path) -> PathState | None:
        state = self._asked.pop(path, None)
        if state is not None:
            self._note_departed(state)
        return state

    def _forget_ready(self) -> None:
        """Forget what stands ready for the next frame and the next envelope: a slot has changed."""
        self.outlet, self.inlet = None, (None, None)

    def _note_departed(self, state: PathState) -> None:
        self._departed = Totals(*map(add, self._departed, _totals_of(state)))

    def learn(self, path: Path, now: float) -> PathState:
        """A slot for an address from which an authentic envelope came first, or which made the session."""
        learned = [state for state in self.by_path.values() if not state.is_configured]
        if len(learned) >= c.LEARNED_PATHS:
            self.remove(min((state for state in learned if state is not self.best), key=_usefulness))
        state = self._new(path, now, is_configured=False, others=self.by_path)
        if (asked := self._forget_asked(path)) is not None:
            state.take_questions(asked)
        self.by_path[path] = state
        self._forget_ready()
        return state

    def remove(self, state: PathState) -> None:
        """Free a slot."""
        del self.by_path[state.path]
        self._forget_ready()
        self._drop(state)
        if state is self.best:
            self.best = None

    def clear(self) -> None:
        """Forget every path: the peer is removed."""
        for state in self.states:
            self.remove(state)

    def _new(self, path: Path, now: float, *, is_configured: bool, others: dict[Path, PathState]) -> PathState:
        taken = {state.number for state in (*others.values(), *self.by_path.values())}
        number = next(number for number in range(1, 256) if number not in taken)
        is_metered, is_stream = path.socket in self.facts.metered, path.socket in self.facts.streams
        return PathState(path, number, now, is_configured=is_configured, is_metered=is_metered, is_stream=is_stream)

    def _drop(self, state: PathState) -> None:
        self._note_departed(state)
        self.unproven += not (state.is_validated or state.is_configured)
        if not state.is_known:
            return
        place = state.path.place
        self._known[place] -= 1
        if not self._known[place]:
            del self._known[place]

    def carrying(self, route: Route, size: int) -> Route:
        """The paths of a route along which an envelope of so many bytes may go: the first one, and its copies."""
        return tuple(
            state
            for state in route
            if (state.is_proven or state.allows(size)) and (state is route[0] or self.carries(state, size))
        )

    def carries(self, state: PathState, size: int) -> bool:
        """Whether a copy of so many bytes may go along a path. Each path carries the longest frame."""
        return size <= min(state.envelope_limit.limit, max(self.network_limit(state), c.MIN_ENVELOPE_LIMIT))

    def network_limit(self, state: PathState) -> int:
        """The longest envelope that the network or the relay of a path carries, in bytes."""
        limit = self.facts.envelope_limits.get(state.path.socket, c.MAX_ENVELOPE_LIMIT)
        return min(limit, c.RELAYED_ENVELOPE_LIMIT) if state.path.is_relayed else limit

    def set_metered(self) -> None:
        """The metered sockets have changed."""
        for state in self.by_path.values():
            state.is_metered = state.path.socket in self.facts.metered

    def set_socket_state(self, socket: int, now: float, *, is_up: bool) -> bool:
        """The network behind a socket disappeared, or appeared, or changed. Returns whether there is a path on it."""
        states = [state for state in self.by_path.values() if state.path.socket == socket]
        for state in states:
            state.set_off(is_off=not is_up, now=now)
        return bool(states)

    def _note_known(self, state: PathState) -> None:
        if not state.is_known:
            state.is_known = True
            self._known[state.path.place] += 1


def _totals_of(state: PathState) -> Totals:
    return Totals(state.datagrams_sent, state.bytes_sent, state.bytes_received)


def _usefulness(state: PathState) -> tuple[bool, float, float]:
    # One that answers again is worth more than one that is suspect, or the honest path loses its slot to former ones.
    return state.works or state.is_recovering, state.answered_at, max(state.received_at, state.since)
