"""A hostile relay: it has a relay's key and no member's key. The real parts of a relay, with attacks between them.

What it forwards passes the attacks of the man in the middle, and it may lie in its own records. It is not in
``uavlink-mitm``, which holds no keys.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path as FilePath
from random import Random
from time import monotonic
from typing import ClassVar, Final

from uavlinkd.config.keys import encode_key
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Event, Output, RecordReceived, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.relay_records import Bound, Record, wrap
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.evaluation.ledger import numbered_frame
from uavlinkd.lab.evaluation.middle import HOST, Interventions, silent_log
from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of
from uavlinkd.lab.mitm.attack import Action, AttackContext, AttackObject, Direction, Intervention, Operation
from uavlinkd.lab.mitm.attacks import ATTACKS, parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.journal import Journal
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.relay.bindings import MemberConnection
from uavlinkd.relay.forwarding import Forwarding, Meter
from uavlinkd.relay.member_settings import MemberSettings, RelayLimits
from uavlinkd.relay.service import RelayService

NAME: Final = "vps"
TICK_S: Final = 0.01
"""How often timers and attacks run."""
AMPLE: Final = RelayLimits(1_000_000, 10**10)
RECORDED: Final = 512
"""Datagrams that the relay keeps, to send them again after its restart."""
_LINK: Final = Link((SUITES_BY_NAME["x25519"],), features=c.FEATURE_REFUSALS | c.FEATURE_RECORDS)
_DATAGRAM_BYTES: Final = 65536


class RelayAttack:
    """An attack on what only a relay does. The base class does nothing."""

    name: ClassVar[str]
    every_s: float = 0.05
    """Between calls of :meth:`act`."""
    reports_after: ClassVar[bool] = False
    """At its end the relay reports the true handles: its members keep wrong ones otherwise, up to 20 s."""

    def __init__(self, relay: HostileRelay, rng: Random) -> None:
        self.relay = relay
        self.rng = rng

    def bound(self, member: str, bound: Bound) -> Bound:
        """What the relay reports to a member instead."""
        del member
        return bound

    def act(self) -> None:
        """Do something by itself."""

    def note(self, operation: Operation, member: str, length: int, detail: str) -> None:
        """Count an attempt."""
        direction = Direction(NAME, member)
        done = Intervention(monotonic(), self.name, operation, direction, 0, DatagramKind.OTHER, length, detail)
        self.relay.journal.add(done)


class LieAboutAddresses(RelayAttack):
    """Reports addresses of others to members as their own: candidates for a search of direct paths."""

    name = "relay-lie"

    def bound(self, member: str, bound: Bound) -> Bound:
        """The victim's address, or one that no member may ask."""
        victims = [self.relay.victim.getsockname(), ("224.0.0.1", 5790), ("255.255.255.255", 5790), ("240.0.0.1", 53)]
        host, port = self.rng.choice(victims)
        self.note(Operation.ALTERED, member, len(bound.encode()), f"{host}:{port}")
        return bound._replace(host=host, port=port)

    def act(self) -> None:
        """Report often."""
        self.relay.report_all()


class BindWrongMembers(RelayAttack):
    """Assigns the handle of one peer for another: a member's datagrams arrive at the wrong one."""

    name = "relay-bind-wrong"
    reports_after = True

    def bound(self, member: str, bound: Bound) -> Bound:
        """Each key has the handles of the next one."""
        keys = list(dict.fromkeys(key for key, _ in bound.handles))
        wrong = dict(zip(keys, [*keys[1:], keys[0]], strict=True))
        self.note(Operation.MISROUTED, member, len(bound.encode()), "handles of other peers")
        return bound._replace(handles=tuple((wrong[key], handle) for key, handle in bound.handles))

    def act(self) -> None:
        """Report often."""
        self.relay.report_all()


class InventHandles(RelayAttack):
    """Sends genuine datagrams with handles that it did not assign, and assigns handles for unknown keys."""

    name = "relay-invent"
    every_s = 0.01

    def bound(self, member: str, bound: Bound) -> Bound:
        """A handle for a key that the member did not ask for."""
        self.note(Operation.INJECTED, member, len(bound.encode()), "unknown key")
        return bound._replace(handles=(*bound.handles[: c.ENTRIES_PER_BOUND - 1], (os.urandom(c.KEY_BYTES), 7)))

    def act(self) -> None:
        """Send a recorded datagram with another handle, or data inside data."""
        for member, _, inner in [*self.relay.recorded][-2:]:
            is_nested = self.rng.random() < 0.3
            data = wrap(self.rng.randrange(1, 2**16), wrap(1, inner) if is_nested else inner)
            self.relay.send_to(member, data)
            self.note(Operation.INJECTED, member, len(data), "nested" if is_nested else "invented handle")


class SendOwnFrames(RelayAttack):
    """Sends MAVLink frames in its own session with each member."""

    name = "relay-frames"

    def act(self) -> None:
        """One frame to each member."""
        for number, member in enumerate(self.relay.keys):
            frame = numbered_frame(1 + (number + 1) % 2, self.rng.randrange(2**31))
            self.relay.send_frames(member, frame)
            self.note(Operation.INJECTED, member, len(frame), "in the relay's own session")


class RestartAndReplay(RelayAttack):
    """Forgets everything, and sends what it recorded before along the handles that it assigns afterwards."""

    name = "relay-restart"
    every_s = 2.5

    def act(self) -> None:
        """Restart. The recorded datagrams follow when the members have bound again."""
        self.relay.restart()


RELAY_ATTACKS: Final = {
    attack.name: attack
    for attack in (LieAboutAddresses, BindWrongMembers, InventHandles, SendOwnFrames, RestartAndReplay)
}


class _LyingNode(Node):
    """The relay's node, which may report something else than the relay knows."""

    relay: HostileRelay

    def send_record(self, peer: Peer, path: Path, record: Record, now: float) -> list[Output]:
        """As the attack wants it."""
        if isinstance(record, Bound) and self.relay.attack_object is not None:
            record = self.relay.attack_object.bound(peer.name, record)
        return super().send_record(peer, path, record, now)


class _NotedForwarding(Forwarding):
    """Remembers which handle belongs to which direction."""

    relay: HostileRelay

    def open(self, connection: MemberConnection, meters: tuple[Meter, Meter]) -> None:
        """Of :class:`Forwarding`."""
        super().open(connection, meters)
        for sender, receiver in (connection, connection[::-1]):
            direction = self.relay.direction(sender.member, receiver.member)
            self.relay.targets[direction] = receiver.handle, receiver.path
            self.relay.directions[receiver.handle, receiver.path] = direction

    def close(self, connection: MemberConnection) -> None:
        """Of :class:`Forwarding`."""
        super().close(connection)
        for end in connection:
            direction = self.relay.directions.pop((end.handle, end.path), None)
            if direction is not None and self.relay.targets.get(direction) == (end.handle, end.path):
                del self.relay.targets[direction]


class HostileRelay:
    """The relay between the members of an evaluation, in this process. It is their man in the middle.

    ``names``: of its members.
    """

    def __init__(self, names: Sequence[str], log: FilePath | None, seed: int) -> None:
        self.ports: Mapping[Direction, int] = {}
        """Of a proxy; members reach a relay by its own port."""
        self._private = os.urandom(c.KEY_BYTES)
        (self.port,) = free_ports(1)
        self.keys: dict[str, bytes] = {}
        """Of the members."""
        self.targets: dict[Direction, tuple[int, Path]] = {}
        self.directions: dict[tuple[int, Path], Direction] = {}
        self.recorded: deque[tuple[str, str, bytes]] = deque(maxlen=RECORDED)
        """Receiver, sender and datagram of what was forwarded last."""
        self.attack_object: RelayAttack | None = None
        self._act_at = 0.0
        self._replays: list[tuple[str, str, bytes]] = []
        self._names = tuple(names)
        self._log, self._seed = log, seed
        self._bytes_to_victim = 0

    @property
    def section(self) -> dict[str, object]:
        """The ``[[relay]]`` of a member."""
        key = encode_key(KeyPair(self._private).public)
        return {"name": NAME, "public_key": key, "addresses": [f"{HOST}:{self.port}"]}

    def direction(self, sender: bytes, receiver: bytes) -> Direction:
        """From one member to another, by their keys."""
        names = {key: name for name, key in self.keys.items()}
        return Direction(names[sender], names[receiver])

    # Life.

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Start for members with these keys. They reach the relay; it does not need their ports."""
        del addresses
        self.keys = dict(public_keys)
        self._sock, self.victim = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for sock, port in ((self._sock, self.port), (self.victim, 0)):
            sock.setblocking(False)
            sock.bind((HOST, port))
        context = AttackContext.between(*self._names, public_keys=self.keys)
        self._channel = AttackChannel(context, (), None, self._seed, monotonic())
        self.journal = Journal(self._log, silent_log(), monotonic(), detail=1000)
        self.restart()
        asyncio.get_running_loop().add_reader(self._sock, self._on_readable)
        self._ticks = asyncio.create_task(self._tick())

    async def stop(self) -> None:
        """Stop without a word."""
        self._ticks.cancel()
        await asyncio.gather(self._ticks, return_exceptions=True)
        asyncio.get_running_loop().remove_reader(self._sock)
        for sock in (self._sock, self.victim):
            sock.close()
        self.journal.close()

    def restart(self) -> None:
        """Forget all sessions, bindings and handles, as a process that was killed and started again."""
        now = monotonic()
        self._replays = [*self.recorded] if isinstance(self.attack_object, RestartAndReplay) else []
        self.targets.clear()
        self.directions.clear()
        self._node = _LyingNode(Secret(self._private), os.urandom, now)
        self._node.relay = self
        self._service = RelayService(
            self._node,
            os.urandom,
            monotonic,
            AMPLE,
            perform=self._perform,
            send=self._forward,
            on_event=lambda event, at: None,
        )
        forwarding = _NotedForwarding(self._forward, monotonic, AMPLE)
        forwarding.relay = self
        self._service.forwarding = forwarding
        members = {
            key: MemberSettings(PeerSettings(name, key, None, _LINK), 16, AMPLE) for name, key in self.keys.items()
        }
        self._service.set_members(members, {}, now)

    # Attacks.

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Replace the attacks: those of the man in the middle, and those in :data:`RELAY_ATTACKS`."""
        assert not objects, "this attacker has no key of a member"
        former, now = self.attack_object, monotonic()
        own = [text for text in specs if text in RELAY_ATTACKS]
        self.attack_object = RELAY_ATTACKS[own[0]](self, Random(f"{self._seed} {own[0]}")) if own else None  # noqa: S311
        self._act_at = now
        self._channel.attacks = tuple(
            parse_attack(text).make(self._channel.context, f"{self._seed} {position}", now)
            for position, text in enumerate(specs)
            if text.partition(",")[0] in ATTACKS
        )
        if former is not None and former.reports_after:
            self.report_all()

    async def statistics(self) -> Interventions:
        """The counters so far. The victim of false addresses is a stranger."""
        with suppress(BlockingIOError):
            while True:
                self._bytes_to_victim += len(self.victim.recv(_DATAGRAM_BYTES))
        counts = {f"{attack}: {operation}": count for (attack, operation), count in self.journal.counts.items()}
        return Interventions(counts, self._bytes_to_victim)

    def report_all(self) -> None:
        """Report to each member the handles of its peers, as after a bind."""
        handles: dict[tuple[str, Path], list[tuple[bytes, int]]] = {}
        for direction, (handle, path) in self.targets.items():
            handles.setdefault((direction.receiver, path), []).append((self.keys[direction.sender], handle))
        for (name, path), of_peers in handles.items():
            member = self._service.members[self.keys[name]]
            bound = Bound(path.host, path.address[1], tuple(of_peers))
            self._perform(self._node.send_record(member.peer, path, bound, monotonic()))

    def send_to(self, member: str, data: bytes) -> None:
        """Send data to a member from the relay's address."""
        for direction, (_, path) in self.targets.items():
            if direction.receiver == member:
                self._send(data, path)
                return

    def send_frames(self, member: str, frame: bytes) -> None:
        """Send a frame in the relay's session with a member."""
        peer = self._service.members[self.keys[member]].peer
        self._perform(self._node.send(peer, [frame], monotonic()))

    # Datagrams.

    def _on_readable(self) -> None:
        with suppress(BlockingIOError):
            for _ in range(256):
                data, source = self._sock.recvfrom(_DATAGRAM_BYTES)
                if data[:1] == wrap(0, b"")[:1]:
                    self._service.take(0, data, source)
                else:
                    self._perform(self._node.receive(data, Path(0, source), monotonic()))
        self._settle()

    def _perform(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, Transmit):
                self._send(output.datagram, output.path)
            elif isinstance(output, RecordReceived):
                self._service.on_record(output, monotonic())
            elif isinstance(output, Event):
                self._service.on_event(output, monotonic())

    def _forward(self, data: bytes, path: Path) -> None:
        """The forwarding step: the attacks decide what arrives where."""
        handle, inner, now = int.from_bytes(data[1:3], "big"), data[3:], monotonic()
        direction = self.directions[handle, path]
        self.recorded.append((direction.receiver, direction.sender, inner))
        self._act(self._channel.on_datagram(inner, direction, now))

    def _act(self, actions: Sequence[Action]) -> None:
        for action in actions:
            if isinstance(action, Intervention):
                self.journal.add(action)
            elif action.direction in self.targets:
                handle, path = self.targets[action.direction]
                self._send(wrap(handle, action.datagram), path)

    def _send(self, data: bytes, path: Path) -> None:
        with suppress(OSError):
            self._sock.sendto(data, path.address)

    # Time.

    async def _tick(self) -> None:
        housekeeping_at = 0.0
        while True:
            now = monotonic()
            self._perform(self._node.handle_timeout(now))
            if now >= housekeeping_at:
                housekeeping_at = now + 1.0
                self._service.do_housekeeping(now)
            self._act(self._channel.due(now))
            if self.attack_object is not None and now >= self._act_at:
                self._act_at = now + self.attack_object.every_s
                self.attack_object.act()
            self._replay(now)
            self._settle()
            await asyncio.sleep(TICK_S)

    def _replay(self, now: float) -> None:
        """Send what was recorded before the restart along the new handles, some at a time."""
        if not self.targets:
            return
        due, self._replays = self._replays[:10], self._replays[10:]
        for receiver, sender, inner in due:
            target = self.targets.get(Direction(sender, receiver))
            if target is not None:
                self._send(wrap(target[0], inner), target[1])
                done = Intervention(
                    now,
                    RestartAndReplay.name,
                    Operation.REPLAYED,
                    Direction(sender, receiver),
                    0,
                    kind_of(inner),
                    len(inner),
                    "after a restart of the relay",
                )
                self.journal.add(done)

    def _settle(self) -> None:
        if self._service.is_due:
            self._service.settle(monotonic())
