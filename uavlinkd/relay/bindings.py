"""Which members of a relay want to reach which, along which of their paths, and the handles for that.

Specification, section 21. Pure: no I/O, no clock, no randomness of its own. The static public key
of a member names it. Methods return the changes that they caused.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product, takewhile
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import Entropy
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.path import Path

HANDLE_BYTES = 2
QUARANTINED_PER_MEMBER = 4096  # a member that changes its paths fast must not use up the handles of another
FEWEST_PEERS = 16  # A member that may ask for fewer has the budget for new wishes of one that may ask for so many.


class ConnectionEnd(NamedTuple):
    """One of the two ends of a connection."""

    member: bytes
    path: Path
    handle: int


class MemberConnection(NamedTuple):
    """A path of one member, connected with a path of another."""

    one: ConnectionEnd
    other: ConnectionEnd


@dataclass(frozen=True, slots=True)
class Changes:
    """What a call changed. ``concerned``: by member and path, the keys whose handles there the member must get.

    No connection is both opened and closed.
    """

    opened: list[MemberConnection] = field(default_factory=list)
    closed: list[MemberConnection] = field(default_factory=list)
    concerned: dict[tuple[bytes, Path], dict[bytes, None]] = field(default_factory=dict)

    def concern(self, member: bytes, path: Path, key: bytes) -> None:
        """The member must get the handles of this key on this path."""
        self.concerned.setdefault((member, path), {})[key] = None

    def concern_both(self, connection: MemberConnection) -> None:
        """Both members must get theirs."""
        for end, other in (connection, connection[::-1]):
            self.concern(end.member, end.path, other.member)


@dataclass(eq=False, slots=True)
class _Wish:
    """Of a member, to reach a key along a path. ``number`` grows from one wish to the next."""

    member: bytes
    key: bytes
    path: Path
    number: int
    until: float = 0.0


class _Member:
    def __init__(self, most_peers: int) -> None:
        self.set_most_peers(most_peers)
        self.wishes: dict[bytes, dict[Path, _Wish]] = {}  # by key
        self.paths: dict[Path, dict[bytes, None]] = {}  # the keys of the wishes along each
        self.handles: set[int] = set()
        self.quarantine: dict[int, float] = {}  # until when, the oldest first
        self.refused = 0

    def set_most_peers(self, most_peers: int) -> None:
        self.most_peers = most_peers
        # Each may close connections and make others, which the other member gets reports about. All wishes that a
        # member may have at once, and as many again in the lifetime of one.
        most = c.HANDLES_PER_PAIR * max(most_peers, FEWEST_PEERS)
        self.new_wishes = TokenBucket(most / c.BIND_LIFETIME_S, most, 0.0)


_Pair = tuple[bytes, bytes]
_Choice = tuple[_Wish, _Wish]


class Bindings:
    """The wishes, connections and handles of all members."""

    def __init__(self, entropy: Entropy) -> None:
        self._entropy = entropy
        self._members: dict[bytes, _Member] = {}
        self._pairs: dict[_Pair, dict[tuple[Path, Path], MemberConnection]] = {}
        self._by_age: OrderedDict[_Wish, None] = OrderedDict()  # the next to end first
        self._wishes = 0  # so far

    # Facts.

    @property
    def connections(self) -> int:
        return sum(map(len, self._pairs.values()))

    def handles(self, member: bytes, path: Path, key: bytes) -> tuple[int, ...]:
        """The handles of a member on a path for a key. Empty: waiting."""
        ends = (end for connection in self._pairs.get(_pair(member, key), {}).values() for end in connection)
        return tuple(end.handle for end in ends if end.member == member and end.path == path)

    def peers_of(self, member: bytes) -> tuple[int, int]:
        """To how many members a member is bound, and how many of its wishes wait."""
        wanted = self._members[member].wishes
        bound = sum(1 for key in wanted if self._pairs.get(_pair(member, key)))
        return bound, len(wanted) - bound

    def paths_of(self, member: bytes) -> list[Path]:
        """The paths along which a member has wishes."""
        return list(self._members[member].paths)

    def wished_at(self, member: bytes, key: bytes) -> float:
        """When a member bound a key last; minus infinity if it has no wish for it."""
        until = max((wish.until for wish in self._wishes_of(member, key).values()), default=-c.NEVER)
        return until - c.BIND_LIFETIME_S

    def refused(self, member: bytes) -> int:
        """How many wishes of a member were ignored so far, because it had or made as many as it may."""
        return self._members[member].refused

    # Members.

    def set_member(self, key: bytes, most_peers: int) -> None:
        """Accept a member, or change how many peers it may ask for. Wishes that it has already stay."""
        if key in self._members:
            if most_peers != self._members[key].most_peers:
                self._members[key].set_most_peers(most_peers)
        else:
            self._members[key] = _Member(most_peers)

    def remove_member(self, key: bytes, now: float) -> Changes:
        """End its connections, and forget it. The wishes of others for it stay, as for any key without a member."""
        changes = self._end([wish for along in self._members[key].wishes.values() for wish in along.values()], now)
        del self._members[key]
        return changes

    # Wishes.

    def bind(self, member: bytes, path: Path, keys: Sequence[bytes], now: float) -> Changes:
        """A member wishes to reach these keys along a path that the relay has validated."""
        changes = Changes()
        for key in dict.fromkeys(keys):
            changes.concern(member, path, key)  # the answer, the same for a key that is not a member
            # A key without a member counts as much: what is left for others must not tell which keys are members.
            if key != member and self._wish(member, key, path, now):
                self._match(_pair(member, key), changes, now)
        return changes

    def end_path(self, member: bytes, path: Path, now: float) -> Changes:
        of_member = self._members[member]
        return self._end([of_member.wishes[key][path] for key in of_member.paths.get(path, ())], now)

    def expire(self, now: float) -> Changes:
        """End the wishes that were not renewed."""
        return self._end(list(takewhile(lambda wish: wish.until <= now, self._by_age)), now)

    def _end(self, wishes: Iterable[_Wish], now: float) -> Changes:
        """End wishes. Then match each pair once: a connection that would be closed again must not be opened."""
        pairs = dict[_Pair, None]()
        for wish in wishes:
            self._remove(wish)
            pairs[_pair(wish.member, wish.key)] = None
        changes = Changes()
        for pair in pairs:
            self._match(pair, changes, now)
        return changes

    def _wish(self, member: bytes, key: bytes, path: Path, now: float) -> bool:
        """Note or renew a wish. Returns whether it is new."""
        of_member = self._members[member]
        wishes = of_member.wishes.get(key, {})
        wish = wishes.get(path)
        is_new = wish is None
        if wish is None:
            is_full = not wishes and len(of_member.wishes) >= of_member.most_peers
            if is_full or not of_member.new_wishes.take(now):
                of_member.refused += 1
                return False
            of_member.wishes[key] = wishes
            if len(wishes) >= c.HANDLES_PER_PAIR:  # more paths could not all have connections
                self._remove(min(wishes.values(), key=lambda wish: wish.until), keeps_key=True)
            self._wishes += 1
            wish = wishes[path] = _Wish(member, key, path, self._wishes)
            of_member.paths.setdefault(path, {})[key] = None
        wish.until = now + c.BIND_LIFETIME_S
        self._by_age[wish] = None
        self._by_age.move_to_end(wish)
        return is_new

    def _remove(self, wish: _Wish, *, keeps_key: bool = False) -> None:
        of_member = self._members[wish.member]
        del self._by_age[wish]
        wishes, keys = of_member.wishes[wish.key], of_member.paths[wish.path]
        del wishes[wish.path], keys[wish.key]
        if not wishes and not keeps_key:
            del of_member.wishes[wish.key]
        if not keys:
            del of_member.paths[wish.path]

    # Connections.

    def _match(self, pair: _Pair, changes: Changes, now: float) -> None:
        """Connect the paths of two members after their wishes have changed."""
        before = self._pairs.get(pair, {})
        one, other = (self._wishes_of(member, key) for member, key in (pair, pair[::-1]))
        chosen = _choose(product(one.values(), other.values()), before)
        for paths in [paths for paths in before if paths not in chosen]:
            self._close(before.pop(paths), changes, now)
        for paths in chosen:
            if paths not in before:
                before[paths] = self._open(pair, paths, changes, now)
        if before:
            self._pairs[pair] = before
        else:
            self._pairs.pop(pair, None)

    def _wishes_of(self, member: bytes, key: bytes) -> Mapping[Path, _Wish]:
        of_member = self._members.get(member)
        return {} if of_member is None else of_member.wishes.get(key, {})

    def _open(self, pair: _Pair, paths: tuple[Path, Path], changes: Changes, now: float) -> MemberConnection:
        members = zip(pair, paths, strict=True)
        ends = (ConnectionEnd(member, path, self._new_handle(member, now)) for member, path in members)
        connection = MemberConnection(*ends)
        changes.opened.append(connection)
        changes.concern_both(connection)
        return connection

    def _close(self, connection: MemberConnection, changes: Changes, now: float) -> None:
        for end in connection:
            of_member = self._members[end.member]
            of_member.handles.remove(end.handle)
            of_member.quarantine[end.handle] = now + c.HANDLE_QUARANTINE_S
            if len(of_member.quarantine) > QUARANTINED_PER_MEMBER:
                del of_member.quarantine[next(iter(of_member.quarantine))]
        changes.closed.append(connection)
        changes.concern_both(connection)

    def _new_handle(self, member: bytes, now: float) -> int:
        of_member = self._members[member]
        quarantine = of_member.quarantine
        while quarantine and quarantine[oldest := next(iter(quarantine))] <= now:
            del quarantine[oldest]
        while True:
            handle = int.from_bytes(self._entropy(HANDLE_BYTES), "big")
            if handle and handle not in of_member.handles and handle not in quarantine:
                of_member.handles.add(handle)
                return handle


def _pair(one: bytes, other: bytes) -> _Pair:
    return (one, other) if one < other else (other, one)


def _choose(choices: Iterable[_Choice], before: Mapping[tuple[Path, Path], object]) -> list[tuple[Path, Path]]:
    """At most :data:`c.HANDLES_PER_PAIR` connections, first between paths without one, then those of ``before``, then
    of the newest wishes. Each member has at most as many paths, so each path has a connection.
    """
    chosen: list[tuple[Path, Path]] = []
    connected: set[_Wish] = set()
    rest = {(one.path, other.path): (one, other) for one, other in choices}
    while rest and len(chosen) < c.HANDLES_PER_PAIR:

        def rank(paths: tuple[Path, Path]) -> tuple[int, bool, int]:
            one, other = rest[paths]
            new = (one not in connected) + (other not in connected)
            return new, paths in before, max(one.number, other.number)

        best = max(rest, key=rank)
        connected.update(rest.pop(best))
        chosen.append(best)
    return chosen
