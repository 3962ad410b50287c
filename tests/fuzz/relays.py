"""A relay: strangers with any datagrams, and members that hold their keys.

The members are nodes of the core with three addresses each. A script lets them bind any keys, seal any payload,
restart and roam; it changes the relay's members, and lets time pass. After each datagram these properties hold. A
stranger gets no byte. No datagram that is forwarded is longer than the one that came, and it goes from one address of
a connection to the other. A datagram with the header 0x50 that is not forwarded is counted once. Tables stay within
their bounds. Afterwards two honest members connect.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Final

from tests.fuzz.engine import Run, Script, play
from tests.fuzz.stages import NOW, SeededEntropy, copier
from tests.protocol.harness import KEY_C, of, quiet
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Dropped, Event, Output, RecordReceived, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.relay_records import (
    INNER_STARTS,
    RELAYED,
    Bind,
    Bound,
    Candidates,
    Record,
    wrap,
)
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.protocol.suites import SUITES_BY_NAME
from uavlinkd.relay.bindings import QUARANTINED_PER_MEMBER, ConnectionEnd
from uavlinkd.relay.forwarding import MemberSettings
from uavlinkd.relay.service import RelayService, RelayShell

MOST_PEERS: Final = 3
"""The highest limit that a script sets. It begins with one."""
LIMITS: Final = 2_000_000
TOTAL: Final = 4_000_000
PRIVATE: Final = tuple(bytes([number]) * c.KEY_BYTES for number in (11, 12, 13, 14))
"""Of the relay, and of three members."""
RELAY_AT: Final = (
    Path(0, ("192.0.2.100", 5790)),
    Path(1, ("2001:db8::100", 5790, 0, 0)),
    Path(2, ("192.0.2.100", 5790)),
)
"""Along each network of a member. The relay has a socket for each family."""
HOMES: Final = tuple(
    (
        Path(0, (f"192.0.2.{number}", 4000)),
        Path(1, (f"2001:db8::{number}", 4000, 0, 0)),
        Path(0, (f"198.18.0.{number}", 4000)),
    )
    for number in (1, 2, 3)
)
"""Where the relay sees each member, by its network."""
STRANGERS: Final = (Path(0, ("198.51.100.7", 4000)), Path(1, ("2001:db8::7", 9, 0, 0)), Path(1, HOMES[0][0].address))
"""The last one is a member's address on the relay's other socket. No datagram of a member comes from them."""
LINK: Final = quiet(features=c.FEATURE_RECORDS, suites=(SUITES_BY_NAME["x25519"],))
KEYS: Final = tuple(KeyPair(private).public for private in PRIVATE)
UNKNOWN: Final = (KEY_C.public, KEYS[0], bytes(c.KEY_BYTES))
"""Not members: a stranger's key, the relay's own, and an invalid one."""
_MOST_DATAGRAMS: Final = 200


class _Member:
    """A member, with its keys: an honest node, and what a script makes it seal."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.homes = HOMES[number]
        self.bounds: list[Bound] = []
        self.recorded: list[bytes] = []
        self.handles: dict[Path, dict[bytes, list[int]]] = {}
        """By its path to the relay, and by key: those that the relay reported last."""
        self.restart(NOW, 0)

    def restart(self, now: float, seed: int) -> None:
        """It forgets its session, and initiates again."""
        self.node = Node(Secret(PRIVATE[1 + self.number]), SeededEntropy(100 * self.number + seed), now)
        self.peer = self.node.add_peer(PeerSettings("relay", KEYS[0], None, LINK), now)
        self.node.set_paths(self.peer, RELAY_AT, now)

    def learn(self, outputs: list[Output]) -> None:
        """Note what the relay reported."""
        for received in of(outputs, RecordReceived):
            if isinstance(received.record, Bound):
                named = self.handles.setdefault(received.path, {})
                of_keys: dict[bytes, list[int]] = {}
                for key, handle in received.record.handles:
                    of_keys.setdefault(key, []).extend([handle] if handle else [])
                named.update(of_keys)


class FuzzedRelay:
    """A relay, its members and the network between them, in virtual time."""

    def __init__(self) -> None:
        self.now = NOW
        entropy = SeededEntropy(9)
        self.node = Node(Secret(PRIVATE[0]), entropy, NOW)
        self.forwarded: list[tuple[bytes, Path]] = []
        shell = RelayShell(entropy, self.clock, self.perform, self.forward, self.on_event)
        self.service = RelayService(self.node, TOTAL, shell)
        self.members = [_Member(number) for number in range(3)]
        self.credit: Counter[Path] = Counter()
        """Bytes that came from an address and were not answered with as many."""
        self._restarts = 0
        self._wire: list[tuple[bytes, Path]] = []  # from the relay
        self.most_peers = 1
        self.set_members(0b111, 1)
        self.settle()

    # What the relay's shell does.

    def clock(self) -> float:
        """The relay's clock."""
        return self.now

    def forward(self, datagram: bytes, path: Path) -> None:
        """The relay forwards."""
        self.forwarded.append((datagram, path))

    def on_event(self, event: Event, now: float) -> None:
        """An event of a member, for the log."""

    def perform(self, outputs: list[Output]) -> None:
        """Of the relay's core."""
        for output in outputs:
            if isinstance(output, Transmit):
                self._charge(output)
                self._wire.append((output.datagram, output.path))
            elif isinstance(output, RecordReceived):
                self.service.on_record(output, self.now)
            elif isinstance(output, Event):
                self.service.on_event(output, self.now)

    def _charge(self, sent: Transmit) -> None:
        assert sent.path not in STRANGERS, "a stranger got an answer"
        states = (peer.paths.find(sent.path) for peer in self.node.peers.values())
        if any(state is not None and state.is_proven for state in states):
            return
        self.credit[sent.path] -= len(sent.datagram)
        assert self.credit[sent.path] >= 0, "more bytes to an unproven address than came from there"

    def arrive(self, datagram: bytes, path: Path) -> None:
        """A datagram comes to the relay."""
        self.credit[path] += len(datagram)
        if datagram[:1] == bytes((RELAYED,)):
            self._take(datagram, path)
            return
        outputs = self.node.receive(datagram, path, self.now)
        refused = sum(1 for out in of(outputs, Dropped) if out.path is not None)
        assert refused == 1 if path in STRANGERS else refused <= 1, f"one datagram, {refused} drops"
        self.perform(outputs)
        self._follow()

    def _take(self, data: bytes, path: Path) -> None:
        """Data along the relay: forwarded once, or counted once."""
        forwarding = self.service.forwarding
        counted, sent = forwarding.dropped.total(), len(self.forwarded)
        self.service.forwarding.take(path.socket, data, path.address)
        added = self.forwarded[sent:]
        assert len(added) + forwarding.dropped.total() - counted == 1, "not forwarded or counted once"
        for datagram, to in added:
            assert len(datagram) <= len(data), "more bytes than came"
            assert data[3] in INNER_STARTS, "other data was forwarded"
            handle = int.from_bytes(data[1:3], "big")
            targets = [
                wrap(other.handle, data[3:])
                for end, other in self._ends()
                if (end.path, end.handle) == (path, handle) and other.path == to
            ]
            assert datagram in targets, "forwarded to an address that the handle does not stand for"

    def _ends(self) -> Iterator[tuple[ConnectionEnd, ConnectionEnd]]:
        for connections in self.service.bindings._pairs.values():
            for one, other in connections.values():
                yield one, other
                yield other, one

    def _follow(self) -> None:
        if self.service.is_due:
            self.service.settle(self.now)

    def settle(self) -> None:
        """Members that are where they say answer the relay, and it answers them, until all are quiet."""
        homes = {
            path: (member, at) for member in self.members for path, at in zip(member.homes, RELAY_AT, strict=True)
        }
        for member in self.members:
            self.send(member, member.node.handle_timeout(self.now))
        for _ in range(_MOST_DATAGRAMS):
            if not self._wire:
                return
            datagram, path = self._wire.pop(0)
            if path in homes:
                member, at = homes[path]
                outputs = member.node.receive(datagram, at, self.now)
                member.learn(outputs)
                self.send(member, outputs)
        raise AssertionError("the relay and its members do not come to an end")

    def send(self, member: _Member, outputs: list[Output]) -> None:
        """What a member sends reaches the relay."""
        for transmit in of(outputs, Transmit):
            member.recorded = [*member.recorded[-15:], transmit.datagram]
            self.arrive(transmit.datagram, member.homes[transmit.path.socket])

    def pass_time(self, seconds: float) -> None:
        """Time passes, and all timers run."""
        until = self.now + seconds
        while self.now < until:
            self.now = min(until, self.now + max(1.0, seconds / 8))
            self.perform(self.node.handle_timeout(self.now))
            self.service.do_housekeeping(self.now)
            self.settle()

    def set_members(self, chosen: int, most_peers: int) -> None:
        """The relay's file has these members from now on."""
        members = {
            key: MemberSettings(PeerSettings(f"member{number}", key, None, LINK), most_peers, LIMITS)
            for number, key in enumerate(KEYS[1:])
            if chosen >> number & 1
        }
        self.most_peers = max(self.most_peers, most_peers)
        self.service.set_members(members, {}, self.now)
        self._follow()

    # Scripts.

    def step(self, script: Script) -> None:
        """One action."""
        what = script.byte()
        member = self.members[(what >> 4 & 3) % 3]
        match what & 15:
            case 0 | 1 | 2:
                self.arrive(self._data(script, member), self._source(script))
            case 3:
                self.arrive(script.take(script.byte()), STRANGERS[script.byte() % 3])
            case 4 | 5 | 6:
                self._record(script, member)
            case 7 if (session := member.peer.sessions.current) is not None:
                sealed = session.seal(script.take(script.byte() & 63), self.now)
                self.arrive(sealed, self._source(script, is_member=True))
            case 8:
                self.pass_time(script.byte() / 16)
            case 9:
                self.pass_time(script.byte() / 2)
            case 10:
                self._restarts += 1
                member.restart(self.now, self._restarts)
                self.settle()
            case 11:
                self.set_members(script.byte(), 1 + script.byte() % MOST_PEERS)
            case 12 if member.recorded:
                recorded = member.recorded[script.byte() % len(member.recorded)]
                self.arrive(recorded, self._source(script, is_member=True))
            case 13:
                for _ in range(script.byte() & 31):
                    self.arrive(self._data(script, member), member.homes[(what >> 6) % 3])
            case _:
                self.settle()

    def _data(self, script: Script, member: _Member) -> bytes:
        how = script.byte()
        handles = [handle for keys in member.handles.values() for those in keys.values() for handle in those]
        handle = handles[how >> 4] if how >> 4 < len(handles) else script.word()
        start = b"" if how & 1 else bytes((sorted(INNER_STARTS)[how >> 1 & 3],))
        return wrap(handle, start + script.take(script.byte() & 31) * (1 + (how >> 3 & 1) * 30))

    def _source(self, script: Script, *, is_member: bool = False) -> Path:
        which = script.byte()
        if which & 8:
            return Path(which >> 4 & 1, (f"203.0.113.{which >> 5}", script.word()))
        if which & 4 and not is_member:
            return STRANGERS[which % 3]
        return HOMES[(which >> 4) % 3][2 if which & 4 else which & 1]

    def _record(self, script: Script, member: _Member) -> None:
        """A member binds any keys, or sends another record, along a path of its choice."""
        how, session = script.byte(), member.peer.sessions.current
        if session is None:
            return
        count = 1 + (how & 15)
        choice = (*KEYS[1:], *UNKNOWN)
        record: Record = Bind(
            tuple(choice[n % 6] if (n := script.byte()) < 224 else bytes((n,)) * c.KEY_BYTES for _ in range(count))
        )
        if how & 0xF0 == 0xF0:
            record = Candidates((("192.0.2.9", script.word()),))
        elif how & 0xF0 == 0xE0:
            record = Bound("192.0.2.9", script.word(), ((KEYS[1], script.word()),))
        path = member.homes[how >> 4 & 1] if how & 0x40 else self._source(script, is_member=True)
        self.arrive(session.seal(session.sealed_record(record.encode()), self.now), path)
        if how & 0x20:
            self.settle()

    # Bounds.

    def check_bounds(self) -> None:
        """No table is larger than what its members may use."""
        service, bindings = self.service, self.service.bindings
        assert len(service.forwarding) <= 2 * bindings.connections, "a route without a connection"
        ends: Counter[bytes] = Counter(end.member for end, _ in self._ends())
        assert bindings.connections * 2 == ends.total(), "a connection that is not counted"
        for key, member in bindings._members.items():
            assert len(member.wishes) <= self.most_peers, "too many wishes"
            assert all(len(wishes) <= c.HANDLES_PER_PAIR for wishes in member.wishes.values()), "too many paths"
            assert len(member.quarantine) <= QUARANTINED_PER_MEMBER, "too many handles in quarantine"
            assert len(member.handles) == ends[key], "a handle without a connection"
        slots = c.CONFIGURED_PATHS + c.LEARNED_PATHS
        assert all(len(asked) <= slots for asked in service._asked.values()), "too many binds wait"
        assert not service._due, "a report that is never sent"

    def check_sequel(self) -> None:
        """Two honest members connect, whatever was before, and data passes in both directions."""
        self.set_members(0b111, MOST_PEERS)
        self.pass_time(c.BIND_LIFETIME_S + c.QUESTION_LIFETIME_S + 30)  # the wishes of before end
        pair = self.members[:2]
        for member in pair:
            self._restarts += 1
            member.restart(self.now, self._restarts)
            member.handles.clear()
        self.pass_time(3.0)
        for member, other in (pair, pair[::-1]):
            bind = Bind((KEYS[1 + other.number],))
            self.send(member, member.node.send_record(member.peer, RELAY_AT[0], bind, self.now))
            self.settle()
        for member, other in (pair, pair[::-1]):
            (handle, *_) = member.handles[RELAY_AT[0]][KEYS[1 + other.number]]
            sent = len(self.forwarded)
            self.arrive(wrap(handle, b"\x40frame"), member.homes[0])
            ((datagram, path),) = self.forwarded[sent:]
            at = RELAY_AT[other.homes.index(path)]
            (theirs, *_) = other.handles[at][KEYS[1 + member.number]]
            assert datagram == wrap(theirs, b"\x40frame")


def make() -> Run:
    """Three members with sessions."""
    relay = FuzzedRelay()
    relay.pass_time(2.0)
    assert all(member.peer.is_up for member in relay.members)
    return play([copier(relay)])
