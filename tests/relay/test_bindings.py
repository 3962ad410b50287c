"""The bindings of a relay: against a model with random histories, and rule by rule."""

from __future__ import annotations

import random
from collections import defaultdict
from collections.abc import Callable, Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.relay_records import wrap
from uavlinkd.relay.bindings import (
    FEWEST_PEERS,
    QUARANTINED_PER_MEMBER,
    Bindings,
    Changes,
    ConnectionEnd,
    MemberConnection,
)
from uavlinkd.relay.forwarding import Forwarding, Meter

A, B, C, D = (bytes([number]) * c.KEY_BYTES for number in range(1, 5))
STRANGER = bytes([9]) * c.KEY_BYTES
MEMBERS = (A, B, C, D)
DATA = b"\x40datagram"
UNLIMITED = 10**13
PATHS = {
    member: [Path(socket, (f"192.0.2.{1 + MEMBERS.index(member)}", port)) for socket in (0, 1) for port in (1, 2, 3)]
    for member in MEMBERS
}


def path(member: bytes, number: int = 0) -> Path:
    """A path of a member."""
    return PATHS[member][number]


def bindings(most_peers: int = 10, draw: Callable[[int], bytes] | None = None) -> Bindings:
    """Of all members. ``draw``: the random source."""
    made = Bindings(draw or random.Random(1).randbytes)
    for member in MEMBERS:
        made.set_member(member, most_peers)
    return made


def connect(made: Bindings, now: float = 0.0) -> MemberConnection:
    """Connect A with B."""
    made.bind(A, path(A), [B], now)
    (connection,) = made.bind(B, path(B), [A], now).opened
    return connection


class Model:
    """The rules, without any concern for cost."""

    def __init__(self) -> None:
        self.wishes: dict[tuple[bytes, bytes, Path], float] = {}
        self.quarantine: dict[tuple[bytes, int], float] = {}
        self.connections: set[MemberConnection] = set()
        self.sent: list[tuple[bytes, Path]] = []
        self.forwarding = Forwarding(lambda *sent: self.sent.append(sent), lambda: 0.0, UNLIMITED)
        self._meters = Meter(UNLIMITED), Meter(UNLIMITED)

    def paths(self, member: bytes, key: bytes) -> set[Path]:
        """Along which a member wishes for a key."""
        return {path for of, wanted, path in self.wishes if (of, wanted) == (member, key)}

    def apply(self, changes: Changes, now: float) -> None:
        """Check what changed by itself."""
        assert not {*changes.opened} & {*changes.closed}
        for connection in changes.closed:
            self.connections.remove(connection)
            for end in connection:
                self.quarantine[end.member, end.handle] = now + c.HANDLE_QUARANTINE_S
            self.forwarding.close(connection)
        for connection in changes.opened:
            self.forwarding.open(connection, self._meters)
            for end in connection:
                assert 0 < end.handle < 2**16
                assert now >= self.quarantine.get((end.member, end.handle), 0.0)
            self.connections.add(connection)
        for end, other in ends(changes.opened + changes.closed):
            assert other.member in changes.concerned[end.member, end.path]

    def check(self, made: Bindings) -> None:
        """Check everything that holds after every step."""
        of_pair: dict[frozenset[bytes], list[MemberConnection]] = defaultdict(list)
        handles: dict[tuple[bytes, Path, bytes], set[int]] = defaultdict(set)
        for connection in self.connections:
            of_pair[frozenset(end.member for end in connection)].append(connection)
        assert len(self.forwarding) == 2 * len(self.connections), "a route without a connection"
        for end, other in ends(self.connections):
            self.forwarding.take(end.path.socket, wrap(end.handle, DATA), end.path.address)
            assert self.sent.pop() == (wrap(other.handle, DATA), other.path)
            assert end.path in self.paths(end.member, other.member)
            handles[end.member, end.path, other.member].add(end.handle)
        every = [(end.member, end.handle) for end, _ in ends(self.connections)]
        assert len(set(every)) == len(every)
        for one in MEMBERS:
            for other_key in MEMBERS:
                theirs, ours = self.paths(other_key, one), self.paths(one, other_key)
                count = len(of_pair[frozenset((one, other_key))]) if one != other_key else 0
                assert count == (min(c.HANDLES_PER_PAIR, len(ours) * len(theirs)) if one != other_key else 0)
                for a_path in PATHS[one]:
                    shown = made.handles(one, a_path, other_key)
                    assert set(shown) == handles[one, a_path, other_key]
                    assert bool(shown) == (a_path in ours and bool(theirs))
        assert made.connections == len(self.connections)


def ends(connections: Iterable[MemberConnection]) -> Iterable[tuple[ConnectionEnd, ConnectionEnd]]:
    """Each end, with the one opposite."""
    return [pair for connection in connections for pair in (tuple(connection), tuple(connection[::-1]))]  # type: ignore[misc]


Step = tuple[str, bytes, int, list[bytes]]
member_keys = st.sampled_from(MEMBERS)
steps: st.SearchStrategy[Step] = st.one_of(
    st.tuples(st.just("bind"), member_keys, st.integers(0, 5), st.lists(st.sampled_from((*MEMBERS, STRANGER)))),
    st.tuples(st.just("end"), member_keys, st.integers(0, 5), st.just([])),
    st.tuples(st.just("leave"), member_keys, st.just(0), st.just([])),
    st.tuples(st.just("wait"), member_keys, st.integers(1, 40), st.just([])),
)


@settings(max_examples=40)
@given(st.integers(0, 1000), st.lists(steps, max_size=40))
def test_random_histories_follow_the_rules(seed: int, history: list[Step]) -> None:
    """Members bind, lose paths, let wishes expire, and are removed and added again. Routes follow."""
    made, model, now = bindings(100, random.Random(seed).randbytes), Model(), 0.0
    for kind, member, number, keys in history:
        if kind == "wait":
            now += number
            changes = made.expire(now)
            model.wishes = {wish: until for wish, until in model.wishes.items() if until > now}
        elif kind == "end":
            changes = made.end_path(member, path(member, number), now)
            gone = [wish for wish in model.wishes if (wish[0], wish[2]) == (member, path(member, number))]
            for wish in gone:
                del model.wishes[wish]
        elif kind == "leave":
            changes = made.remove_member(member, now)
            made.set_member(member, 100)
            model.wishes = {wish: until for wish, until in model.wishes.items() if wish[0] != member}
        else:
            changes = made.bind(member, path(member, number), keys, now)
            for key in dict.fromkeys(keys):
                assert key in changes.concerned[member, path(member, number)]
                if key in (member, STRANGER):
                    continue
                wish = member, key, path(member, number)
                others = {(member, key, other) for other in model.paths(member, key)} - {wish}
                if wish not in model.wishes and len(others) >= c.HANDLES_PER_PAIR:
                    # Of equally old ones, any may go: the one that the bindings chose has no handle any more.
                    least = min(model.wishes[other] for other in others)
                    oldest = [other for other in others if model.wishes[other] == least]
                    kept = [other for other in oldest if other[2] in made._members[member].wishes[key]]
                    del model.wishes[next((other for other in oldest if other not in kept), oldest[0])]
                model.wishes[wish] = now + c.BIND_LIFETIME_S
        model.apply(changes, now)
        model.check(made)


# Rule by rule.


@pytest.mark.parametrize("key", [STRANGER, C, A], ids=["unknown", "absent", "its own"])
def test_answer_does_not_tell_who_exists(key: bytes) -> None:
    """The same for a key that is not a member, for a member that did not ask, and for the member's own."""
    made = bindings()
    assert made.bind(A, path(A), [key], 0.0) == Changes([], [], {(A, path(A)): {key: None}})
    assert made.handles(A, path(A), key) == ()


def test_handle_is_quarantined() -> None:
    """It is not given to its member again until then, although the random source returns it."""
    draws = [1, 2, 1, 2, 3, 2, 4]  # A's, B's; then both again
    made = bindings(draw=lambda size: (draws.pop(0) if draws else 1).to_bytes(size, "big"))
    assert {end.handle for end in connect(made)} == {1, 2}
    made.end_path(A, path(A), 1.0)
    made.bind(A, path(A), [B], 2.0)
    assert made.handles(A, path(A), B) == (2,)  # which was only B's
    assert made.handles(B, path(B), A) == (3,)
    draws[:] = [1, 5]
    made.bind(B, path(B), [A], 1.0 + c.HANDLE_QUARANTINE_S)
    made.end_path(A, path(A), 1.0 + c.HANDLE_QUARANTINE_S)
    made.bind(A, path(A), [B], 1.0 + c.HANDLE_QUARANTINE_S)
    assert made.handles(A, path(A), B) == (1,)


def test_zero_is_not_a_handle() -> None:
    """It stands for none."""
    draws = [0, 7, 0, 8]
    made = bindings(draw=lambda size: draws.pop(0).to_bytes(size, "big"))
    assert {end.handle for end in connect(made)} == {7, 8}


def test_member_that_changes_its_paths_fast_does_not_use_up_the_handles_of_another() -> None:
    """Of 65,535 handles at most so many rest; the others are free for other members."""
    made = bindings(most_peers=QUARANTINED_PER_MEMBER)
    made.bind(A, path(A), [B, C], 0.0)
    made.bind(C, path(C), [A], 0.0)
    used = set[int]()
    for port in range(1, 3 * QUARANTINED_PER_MEMBER):
        made.bind(B, Path(0, ("192.0.2.7", port)), [A], 1.0)
        used.update(made.handles(A, path(A), B))
        made.end_path(B, Path(0, ("192.0.2.7", port)), 1.0)
    assert len(used) > 2 * QUARANTINED_PER_MEMBER
    assert made.handles(A, path(A), C)
    assert made.connections == 1


@pytest.mark.parametrize("key", [STRANGER, C], ids=["unknown", "absent"])
def test_what_is_left_does_not_tell_who_exists(key: bytes) -> None:
    """A wish for a key without a member counts as one for a member that did not ask."""
    made = bindings(most_peers=1)
    made.bind(B, path(B), [A], 0.0)
    made.bind(A, path(A), [key], 0.0)
    assert made.bind(A, path(A), [B], 0.0).opened == []
    assert (made.peers_of(A), made.refused(A)) == ((0, 1), 1)


@pytest.mark.parametrize("key", [STRANGER, B], ids=["unknown", "connected"])
def test_new_wishes_have_a_budget(key: bytes) -> None:
    """A member that asks from ever new paths makes no more connections, and none of the reports, than it may.
    Renewals cost nothing. A key without a member costs as much.
    """
    made = bindings()
    connect(made)
    most = c.HANDLES_PER_PAIR * FEWEST_PEERS - 1
    changes = [made.bind(A, Path(0, ("192.0.2.7", port)), [key], 0.0) for port in range(1, 1000)]
    assert sum(len(change.opened) for change in changes) == (most if key == B else 0)
    assert made.refused(A) == 999 - most
    made.bind(A, Path(0, ("192.0.2.7", most)), [key], 0.0)
    assert made.refused(A) == 999 - most
    assert made.bind(A, path(A, 1), [B], 0.0).opened == []
    assert made.bind(A, path(A, 1), [B], c.BIND_LIFETIME_S / most).opened


def test_lower_limit_keeps_what_is_there() -> None:
    """It counts for new wishes."""
    made = bindings()
    made.bind(A, path(A), [B, C], 0.0)
    made.set_member(A, 1)
    made.bind(A, path(A), [B, C, D], 1.0)
    assert made.peers_of(A) == (0, 2)
    assert made.refused(A) == 1
