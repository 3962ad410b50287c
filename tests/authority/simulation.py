"""Members of a fleet with the real rules and the real exchange, and a network between them, in virtual time."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from functools import cache
from itertools import count
from math import inf

from tests.authority.signing import AUTHORITY, bulletin, signed, vehicle
from uavlinkd.authority.exchange import ROLLED_BACK, BulletinExchange, Reaction
from uavlinkd.authority.trust import BulletinVerdict, Trust
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.relay_records import FleetRecord, Have, parse_record
from uavlinkd.core.wire import LONG_HEADER_BYTES

ONE_WAY_S = 0.02
WRITE_S = 0.005
OVERHEAD_BYTES = LONG_HEADER_BYTES + 1 + 16 + 16
FIRST = bulletin(1)
"""Of every member's configuration."""


def key_of(number: int) -> bytes:
    """The static public key of a member."""
    return number.to_bytes(2, "big") * 16


@cache
def certificate_of(number: int, serial: int) -> bytes:
    """A certificate of a member."""
    return signed(vehicle(number, serial), key_of(number))


class SimulatedMember:
    """One member: what its daemon knows, and its disk."""

    def __init__(self, number: int, entropy: Callable[[int], bytes]) -> None:
        self.number, self.key, self.serial = number, key_of(number), number
        self.entropy = entropy
        self.disk, self.old_disk = FIRST, FIRST
        self.is_writable = True
        self.highest_stated = 0
        """By *have*, since its disk was restored."""
        self.wakes_at = inf
        self.start()

    def start(self) -> None:
        """It knows its disk and its configuration."""
        self.trust = Trust(AUTHORITY, self.key, certificate_of(self.number, self.serial), FIRST)
        self.trust.receive_bulletin(self.disk)
        self.exchange = BulletinExchange(self.trust, self.entropy)
        self.up: set[int] = set()
        self.seen: dict[int, tuple[int, int]] = {}
        """Of each other member: order and number of the last *have*."""
        self.events: list[tuple[int, str]] = []
        self.epoch = object()
        """What began before a restart does not end."""


class SimulatedFleet:
    """The members, which links of them are up, and what is on its way."""

    def __init__(self, size: int, seed: int, *, is_reordered: bool = False) -> None:
        self._rng = random.Random(seed)
        self.loss = 0.0
        self._delays = (ONE_WAY_S, 3 * ONE_WAY_S) if is_reordered else (ONE_WAY_S,)
        self.now = 100.0
        self.members = {number: SimulatedMember(number, self._rng.randbytes) for number in range(1, size + 1)}
        self.restored: set[int] = set()
        """Members whose disks were restored."""
        self.bytes_sent = 0
        self._coming: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = count(1)

    # Links.

    def connect(self, one: int, other: int) -> bool:
        """Make a session, unless one end refuses the other. Returns whether it did not."""
        first, second = self.members[one], self.members[other]
        for here, there in ((first, second), (second, first)):
            try:
                ended = here.trust.hold(there.key, certificate_of(there.number, there.serial))
            except Drop as drop:
                if drop.reason is not DropReason.CERTIFICATE_REVOKED:
                    raise
                self.disconnect(one, other)
                return False
            assert ended == []
            held = here.trust.held[there.key].certificate
            assert not here.trust.bulletin.refuses(held.serial), "a revoked serial was accepted"
        self.link(one, other)
        return True

    def link(self, one: int, other: int) -> None:
        """Make a session without certificates."""
        first, second = self.members[one], self.members[other]
        for here, there in ((first, second), (second, first)):
            here.up.add(there.number)
            here.exchange.on_handshake(there.key, 4 * ONE_WAY_S, self.now)

    def disconnect(self, one: int, other: int, *, is_noticed: bool = True) -> None:
        """Nothing arrives any more. If an end restarted, the other may not notice before it is back."""
        for here, there in ((one, other), (other, one)):
            self.members[here].up.discard(there)
            if is_noticed:
                self.members[here].exchange.on_down(key_of(there))

    def restart(self, number: int, *, is_restored: bool = False, is_noticed: bool = True) -> None:
        """The process ends, and starts from its disk, or from an older copy of it."""
        member = self.members[number]
        for other in list(member.up):
            self.disconnect(number, other, is_noticed=is_noticed)
        if is_restored and member.disk != member.old_disk:
            member.disk, member.highest_stated = member.old_disk, 0
            self.restored.add(number)
        member.start()

    # Bulletins.

    def publish(self, number: int, data: bytes) -> BulletinVerdict:
        """The operator gives a bulletin to one member."""
        member = self.members[number]
        verdict, reaction = member.exchange.publish(data, self.now)
        self._react(member, reaction)
        return verdict

    def newest(self) -> list[int]:
        """The number that each member enforces."""
        return [member.trust.bulletin.number for member in self.members.values()]

    def _react(self, member: SimulatedMember, reaction: Reaction) -> None:
        for key in reaction.ended:
            self.disconnect(member.number, int.from_bytes(key[:2], "big"))
        if reaction.persists:
            self._later(WRITE_S, lambda epoch=member.epoch: self._write(member, epoch))  # type: ignore[misc]

    def _write(self, member: SimulatedMember, epoch: object) -> None:
        if member.is_writable and epoch is member.epoch:
            member.disk = member.trust.bulletin_bytes
            member.exchange.note_persisted(member.trust.bulletin.number, member.trust.digest)
            self._wake(member)

    def repair_disk(self, number: int) -> None:
        """It can be written again, and is."""
        member = self.members[number]
        member.is_writable = True
        self._write(member, member.epoch)

    # Time.

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

    def _wake(self, member: SimulatedMember) -> None:
        if member.exchange.next_at < member.wakes_at:
            member.wakes_at = member.exchange.next_at
            self._later(max(0.0, member.wakes_at - self.now), lambda: self._send(member))

    def _send(self, member: SimulatedMember) -> None:
        member.wakes_at = inf
        for key, record in member.exchange.do_due(self.now):
            other = self.members[int.from_bytes(key[:2], "big")]
            order, data = next(self._numbers), record.encode()
            self.bytes_sent += len(data) + OVERHEAD_BYTES
            if isinstance(record, Have):
                assert record.number >= member.highest_stated, "a have fell"
                assert record.number <= member.trust.bulletin.number
                member.highest_stated = record.number
            if other.number in member.up and self._rng.random() >= self.loss:
                delay = self._rng.choice(self._delays)
                self._later(delay, lambda e=other.epoch, a=(other, member, data, order): self._deliver(e, *a))  # type: ignore[misc]
        self._wake(member)

    def _deliver(
        self, epoch: object, member: SimulatedMember, sender: SimulatedMember, data: bytes, order: int
    ) -> None:
        if sender.number not in member.up or epoch is not member.epoch:
            return
        record = parse_record(data)
        assert isinstance(record, FleetRecord)
        before = member.seen.get(sender.number, (0, 0))
        try:
            reaction = member.exchange.receive(sender.key, record, order, self.now)
        except Drop as drop:
            is_overtaken = drop.reason is DropReason.OLD_RECORD and order < before[0]
            if not is_overtaken and drop.reason is not DropReason.RECORD_OVER_LIMIT:
                raise
            return
        if isinstance(record, Have):
            member.seen[sender.number] = (order, record.number)
            assert (reaction.event == ROLLED_BACK) == (record.number < before[1])
            assert reaction.event != ROLLED_BACK or sender.number in self.restored
        if reaction.event:
            member.events.append((sender.number, reaction.event))
        self._react(member, reaction)
        self._wake(member)
        for other in member.up:
            assert not member.trust.bulletin.refuses(self.members[other].serial), "a link with a revoked serial"
