"""A hostile relay as a daemon: the real parts of a relay, with attacks between them.

What it forwards passes the attacks of the man in the middle, and it may lie in its own records. It has a relay's key,
and no key of a member or of a session between two members.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Final

from uavlinkd.config.model import RelayServer
from uavlinkd.io.reader import RECEIVE_BYTES
from uavlinkd.io.sockets import udp_socket
from uavlinkd.lab.hostile.relay_attacks import ALL_ATTACKS, Lie, RelayAttack, RelayContext
from uavlinkd.lab.mitm.attack import Action, AttackContext, AttackObject, Direction, Intervention
from uavlinkd.lab.mitm.attack_service import ChannelService
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.proxy import received
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Event, Output, RecordReceived, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import (
    RELAYED,
    Bound,
    Record,
    bounds_of,
    wrap,
)
from uavlinkd.relay.bindings import MemberConnection
from uavlinkd.relay.forwarding import Forwarding, Meter
from uavlinkd.relay.service import RelayService, RelayShell
from uavlinkd.system.addresses import Address

TICK_S: Final = 0.01
HOUSEKEEPING_S: Final = 1.0
VICTIM_HOST: Final = "127.0.0.1"
_START: Final = bytes((RELAYED,))


@dataclass(frozen=True, slots=True)
class HostileRelaySettings:
    """A relay as in its file, and the attacks."""

    name: str
    private_key: Secret
    listen: tuple[Address, ...]
    server: RelayServer
    seed: int = 0


class _LyingNode(Node):
    """The relay's node, which may report something else than the relay knows."""

    relay: HostileRelay

    def send_record(self, peer: Peer, path: Path | None, record: Record, now: float) -> list[Output]:
        if isinstance(record, Bound):
            record = self.relay.falsified(peer.name, record, now)
        return super().send_record(peer, path, record, now)


class _NotedForwarding(Forwarding):
    """Remembers which handle belongs to which direction."""

    relay: HostileRelay

    def open(self, connection: MemberConnection, meters: tuple[Meter, Meter]) -> None:
        super().open(connection, meters)
        for sender, receiver in (connection, connection[::-1]):
            self.relay.connect(self.relay.direction(sender.member, receiver.member), (receiver.handle, receiver.path))

    def close(self, connection: MemberConnection) -> None:
        super().close(connection)
        for end in connection:
            self.relay.disconnect((end.handle, end.path))


_Target = tuple[int, Path]
"""A handle of a member, and its path."""


class HostileRelay(ChannelService):
    """A relay that attacks its members."""

    kind = "relay"
    known = ALL_ATTACKS

    def __init__(self, settings: HostileRelaySettings) -> None:
        super().__init__(settings.seed)
        self.settings = settings
        self.name = settings.name
        self.keys = {member.name: member.peer.public_key for member in settings.server.members}
        self._names = {key: name for name, key in self.keys.items()}
        around = AttackContext.between(*self.keys, public_keys=self.keys)
        self.context = RelayContext(around.directions, around.public_keys, relay=self)
        self.received: Counter[Direction] = Counter()
        self.sent: Counter[Direction] = Counter()
        self._directions: dict[_Target, Direction] = {}
        self._targets: dict[Direction, _Target] = {}  # of several, the one that was used last
        self._sockets: list[socket.socket] = []
        self._bytes_to_victim = 0

    async def start(self) -> None:
        self._began_at = now = monotonic()
        self._victim = udp_socket(Address(VICTIM_HOST, 0))
        self.channel = AttackChannel(self.context, (), None, self.seed, now)
        try:
            for address in self.settings.listen:
                self._sockets.append(udp_socket(address))
        except BaseException:
            await self._close()
            raise
        self._serve(now)
        for number, sock in enumerate(self._sockets):
            asyncio.get_running_loop().add_reader(sock, self._on_readable, number, sock)
        self._ticks = asyncio.create_task(self._tick())
        listen = list(map(str, self.addresses))
        self.event("started", seed=self.seed, listen=listen)

    @property
    def addresses(self) -> list[Address]:
        return [Address(*sock.getsockname()[:2]) for sock in self._sockets]

    async def stop(self) -> None:
        """Stop without a word to the members."""
        self._ticks.cancel()
        await asyncio.gather(self._ticks, return_exceptions=True)
        await super().stop()

    async def _close(self) -> None:
        for sock in (*self._sockets, self._victim):
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()

    def _serve(self, now: float) -> None:
        """Make a relay without sessions, bindings and handles."""
        self._node = _LyingNode(self.settings.private_key, os.urandom, now)
        self._node.relay = self
        shell = RelayShell(
            entropy=os.urandom,
            clock=monotonic,
            perform=self._perform,
            send=self._forward,
            on_event=lambda event, at: None,
        )
        self._service = RelayService(self._node, self.settings.server.bits_s, shell)
        forwarding = _NotedForwarding(self._forward, monotonic, self.settings.server.bits_s)
        forwarding.relay = self
        self._service.forwarding = forwarding
        self._service.set_members(self.settings.server.by_key, {}, now)
        self._housekeeping_at = now + HOUSEKEEPING_S

    def statistics(self) -> dict[str, object]:
        with suppress(OSError):  # empty
            while True:
                self._bytes_to_victim += len(self._victim.recv(RECEIVE_BYTES))
        return {
            **super().statistics(),
            "members_up": [member.settings.name for member in self._service.members.values() if member.peer.is_up],
            "received": {str(direction): count for direction, count in self.received.items()},
            "sent": {str(direction): count for direction, count in self.sent.items()},
            "strangers": {"bytes_back": self._bytes_to_victim, "amplified": {}},
        }

    def change_attacks(self, attacks: Sequence[AttackObject]) -> None:
        former = self.channel.attacks
        super().change_attacks(attacks)
        if any(isinstance(attack, RelayAttack) and attack.reports_after for attack in former):
            self.report_all()

    # From the attacks: see :class:`.AttackedRelay`.

    @property
    def victim(self) -> tuple[str, int]:
        host, port = self._victim.getsockname()
        return host, port

    def report_all(self) -> None:
        handles: dict[tuple[str, Path], dict[bytes, list[int]]] = {}
        for (handle, path), direction in self._directions.items():
            of_path = handles.setdefault((direction.receiver, path), {})
            of_path.setdefault(self.keys[direction.sender], []).append(handle)
        for (name, path), of_peers in handles.items():
            host, port = path.address[:2]
            for bound in bounds_of(host.partition("%")[0], port, of_peers):
                self._perform(self._node.send_record(self._peer(name), path, bound, monotonic()))

    def send_data(self, member: str, handle: int, inner: bytes) -> None:
        for path in (path for direction, (_, path) in self._targets.items() if direction.receiver == member):
            self._send(wrap(handle, inner), path)
            return

    def send_frames(self, member: str, frame: bytes) -> None:
        self._perform(self._node.send(self._peer(member), [frame], monotonic()))

    def _peer(self, name: str) -> Peer:
        return self._service.members[self.keys[name]].peer

    # From the parts of the relay.

    def falsified(self, member: str, bound: Bound, now: float) -> Bound:
        """What the attacks report to a member instead."""
        for attack in self.channel.attacks:
            if isinstance(attack, Lie):
                bound = attack.report(member, bound, now)
        return bound

    def direction(self, sender: bytes, receiver: bytes) -> Direction:
        """From one member to another, by their keys."""
        return Direction(self._names[sender], self._names[receiver])

    def connect(self, direction: Direction, target: _Target) -> None:
        """A member has a handle for this direction."""
        self._directions[target] = direction
        self._targets[direction] = target

    def disconnect(self, target: _Target) -> None:
        """A member has a handle no more."""
        direction = self._directions.pop(target, None)
        if direction is not None and self._targets[direction] == target:
            del self._targets[direction]
            self._targets |= {other: left for left, other in self._directions.items() if other == direction}

    # Datagrams.

    def _on_readable(self, number: int, sock: socket.socket) -> None:
        for data, source in received(sock):
            if data.startswith(_START):
                self._service.forwarding.take(number, data, source)
            else:
                self._perform(self._node.receive(data, Path(number, source), monotonic()))
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
        target = int.from_bytes(data[1:3], "big"), path
        direction = self._directions[target]
        self._targets[direction] = target
        self.received[direction] += 1
        self._act(self.channel.on_datagram(data[3:], direction, monotonic()))

    def _act(self, actions: Sequence[Action]) -> None:
        for action in actions:
            if isinstance(action, Intervention):
                self.count(action)
            elif (target := self._targets.get(action.direction)) is not None:
                handle, path = target
                self.sent[action.direction] += 1
                self._send(wrap(handle, action.datagram), path)

    def _send(self, data: bytes, path: Path) -> None:
        with suppress(OSError):
            self._sockets[path.socket].sendto(data, path.address)

    # Time.

    async def _tick(self) -> None:
        while True:
            now = monotonic()
            self._perform(self._node.handle_timeout(now))
            if now >= self._housekeeping_at:
                self._housekeeping_at = now + HOUSEKEEPING_S
                self._service.do_housekeeping(now)
            self._act(self.channel.due(now))
            self._settle()
            await asyncio.sleep(TICK_S)

    def _settle(self) -> None:
        if self._service.is_due:
            self._service.settle(monotonic())
