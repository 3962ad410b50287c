"""How fast a bulletin reaches all members, with the real rules and the real exchange, in virtual time."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Iterable
from itertools import combinations, count
from math import inf

import pytest

from tests.authority.signing import AUTHORITY, bulletin, signed, vehicle
from uavlinkd.authority.exchange import BulletinExchange, Reaction
from uavlinkd.authority.trust import Trust
from uavlinkd.protocol.relay_records import FleetRecord, parse_record
from uavlinkd.protocol.wire import LONG_HEADER_BYTES

ONE_WAY_S = 0.02
WRITE_S = 0.005
OVERHEAD_BYTES = LONG_HEADER_BYTES + 1 + 16 + 16
MEMBERS = 50
NEW = bulletin(2, 101, 102, 103)
MESH = tuple(combinations(range(1, MEMBERS + 1), 2))
STAR = tuple((1, other) for other in range(2, MEMBERS + 1))
LINE = tuple((number, number + 1) for number in range(1, MEMBERS))


def key_of(number: int) -> bytes:
    """The static public key of a member."""
    return number.to_bytes(2, "big") * 16


class Member:
    """What its daemon knows, and the members with which it has a link."""

    def __init__(self, number: int, entropy: Callable[[int], bytes]) -> None:
        self.key = key_of(number)
        self.trust = Trust(AUTHORITY, self.key, signed(vehicle(number, number), self.key), bulletin(1))
        self.exchange = BulletinExchange(self.trust, entropy)
        self.up: set[int] = set()
        self.wakes_at = inf


class Fleet:
    """The members, and what is on its way between them."""

    def __init__(self, links: Iterable[tuple[int, int]]) -> None:
        self._rng = random.Random(1)
        self.loss = 0.0
        self.now = 100.0
        self.members = {number: Member(number, self._rng.randbytes) for number in range(1, MEMBERS + 1)}
        self.bytes_sent = 0
        self._coming: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = count(1)
        for one, other in links:
            for here, there in ((one, other), (other, one)):
                self.members[here].up.add(there)
                self.members[here].exchange.on_handshake(key_of(there), self.now)

    def publish(self, number: int, data: bytes) -> None:
        """The operator gives a bulletin to one member."""
        member = self.members[number]
        self._react(member, member.exchange.publish(data, self.now)[1])

    def have_all(self, number: int) -> bool:
        """Whether each member enforces the bulletin of this number."""
        return all(member.trust.bulletin.number == number for member in self.members.values())

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """Let time pass until a condition holds. Returns how long it took, infinity if it did not hold."""
        start, end = self.now, self.now + seconds
        for member in self.members.values():
            self._wake(member)
        while not until():
            if not self._coming or self._coming[0][0] > end:
                self.now = end
                return inf
            self.now, _, action = heapq.heappop(self._coming)
            action()
        return self.now - start

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._coming, (self.now + seconds, next(self._numbers), action))

    def _wake(self, member: Member) -> None:
        if member.exchange.next_at < member.wakes_at:
            member.wakes_at = member.exchange.next_at
            self._later(max(0.0, member.wakes_at - self.now), lambda: self._send(member))

    def _send(self, member: Member) -> None:
        member.wakes_at = inf
        for key, record in member.exchange.do_due(self.now):
            order, data = next(self._numbers), record.encode()
            self.bytes_sent += len(data) + OVERHEAD_BYTES
            if self._rng.random() >= self.loss:
                other = self.members[int.from_bytes(key[:2], "big")]
                self._later(ONE_WAY_S, lambda a=(other, member.key, data, order): self._deliver(*a))  # type: ignore[misc]
        self._wake(member)

    def _deliver(self, member: Member, sender: bytes, data: bytes, order: int) -> None:
        record = parse_record(data)
        assert isinstance(record, FleetRecord)
        self._react(member, member.exchange.receive(sender, record, order, self.now))

    def _react(self, member: Member, reaction: Reaction) -> None:
        if reaction.persists:
            self._later(WRITE_S, lambda: self._write(member))
        self._wake(member)

    def _write(self, member: Member) -> None:
        member.exchange.note_persisted(member.trust.bulletin.number, member.trust.digest)
        self._wake(member)


@pytest.mark.parametrize(
    ("links", "loss", "within_s", "most_kb"),
    [
        pytest.param(MESH, 0.0, 0.1, 300, id="mesh"),
        pytest.param(MESH, 0.3, 0.15, 500, id="mesh, 30 %"),
        pytest.param(STAR, 0.0, 0.13, 15, id="star"),
        pytest.param(STAR, 0.1, 0.8, 20, id="star, 10 %"),
        pytest.param(STAR, 0.3, 1.5, 30, id="star, 30 %"),
        pytest.param(LINE, 0.0, 4.0, 15, id="line"),
        pytest.param(LINE, 0.1, 6.5, 20, id="line, 10 %"),
        pytest.param(LINE, 0.3, 11.5, 30, id="line, 30 %"),
    ],
)
def test_last_of_fifty_members_has_it(
    links: Iterable[tuple[int, int]], loss: float, within_s: float, most_kb: int
) -> None:
    """Round trips of 40 ms. Once all have it, nothing more is sent."""
    fleet = Fleet(links)
    fleet.run(1.0)
    fleet.loss, fleet.bytes_sent = loss, 0
    fleet.publish(1, NEW)
    assert fleet.run(60.0, lambda: fleet.have_all(2)) <= within_s
    fleet.run(60.0)
    assert fleet.bytes_sent <= 1000 * most_kb
    fleet.loss, fleet.bytes_sent = 0.0, 0
    fleet.run(60.0)
    assert fleet.bytes_sent == 0
    for member in fleet.members.values():
        assert all(member.exchange.shown(key_of(other)) == 2 for other in member.up)
