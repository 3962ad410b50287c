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
from functools import partial
from pathlib import Path as FilePath
from time import monotonic
from typing import Final

import structlog

from uavlinkd.config import RelayServer
from uavlinkd.core.crypto import Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Event, Output, RecordReceived, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.relay_records import (
    RELAYED,
    Bound,
    FilterTested,
    Record,
    bounds_of,
    token_datagram,
    token_of,
    wrap,
)
from uavlinkd.endpoints.reader import DATAGRAMS_PER_WAKE_UP, RECEIVE_BYTES
from uavlinkd.endpoints.sockets import send_from_new_port, udp_socket
from uavlinkd.lab.hostile.relay_attacks import ALL_ATTACKS, Lie, LieAboutFilters, RelayAttack, RelayContext
from uavlinkd.lab.mitm.attack import Action, AttackContext, AttackObject, Direction, Intervention
from uavlinkd.lab.mitm.attack_requests import MAX_REQUEST_BYTES, answer_request
from uavlinkd.lab.mitm.attacks import AttackSpec, parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.journal import Journal
from uavlinkd.lab.mitm.proxy_settings import LOG_DETAIL
from uavlinkd.ops.control import ControlServer
from uavlinkd.relay.bindings import MemberConnection
from uavlinkd.relay.forwarding import Forwarding, Meter
from uavlinkd.relay.service import RelayService
from uavlinkd.system.addresses import Address

TICK_S: Final = 0.01
"""How often timers and attacks run."""
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
    attacks: tuple[AttackSpec, ...] = ()
    seed: int = 0
    log: FilePath | None = None
    log_detail: int = LOG_DETAIL
    control_socket: FilePath | None = None


class _LyingNode(Node):
    """The relay's node, which may report something else than the relay knows."""

    relay: HostileRelay

    def send_record(self, peer: Peer, path: Path, record: Record, now: float) -> list[Output]:
        """As the attacks want it."""
        if isinstance(record, Bound):
            record = self.relay.falsified(peer.name, record, now)
        return super().send_record(peer, path, record, now)


class _NotedForwarding(Forwarding):
    """Remembers which handle belongs to which direction."""

    relay: HostileRelay

    def open(self, connection: MemberConnection, meters: tuple[Meter, Meter]) -> None:
        """Of :class:`Forwarding`."""
        super().open(connection, meters)
        for sender, receiver in (connection, connection[::-1]):
            self.relay.connect(self.relay.direction(sender.member, receiver.member), (receiver.handle, receiver.path))

    def close(self, connection: MemberConnection) -> None:
        """Of :class:`Forwarding`."""
        super().close(connection)
        for end in connection:
            self.relay.disconnect((end.handle, end.path))


_Target = tuple[int, Path]
"""A handle of a member, and its path."""


class HostileRelay:
    """A relay that attacks its members. Call :meth:`start` first and :meth:`stop` last."""

    def __init__(self, settings: HostileRelaySettings) -> None:
        self.settings = settings
        self.name = settings.name
        self.log = structlog.get_logger().bind(daemon="hostile relay")
        self.keys = {member.name: member.peer.public_key for member in settings.server.members}
        """Of the members: public ones."""
        around = AttackContext.between(*self.keys, public_keys=self.keys)
        self.context = RelayContext(around.directions, around.public_keys, relay=self)
        self.received: Counter[Direction] = Counter()
        """Datagrams to be forwarded."""
        self.sent: Counter[Direction] = Counter()
        self.stopping = asyncio.Event()
        """Set by the request ``stop`` on the control socket."""
        self._names = {key: name for name, key in self.keys.items()}
        self._open: dict[_Target, Direction] = {}
        self._targets: dict[Direction, _Target] = {}  # of several, the one that was used last
        self._sockets: list[socket.socket] = []
        self._bytes_to_victim = 0
        self._control: ControlServer | None = None

    async def start(self) -> None:
        """Listen, and serve the members.

        Raises:
            BindError: an address cannot be bound.
            AttackError: these members do not allow an attack.
            ControlError: the control socket cannot be used.
            OSError: the log file cannot be written.
        """
        self._began_at = now = monotonic()
        self._loop = asyncio.get_running_loop()
        self.channel = AttackChannel(self.context, self._make(self.settings.attacks), None, self.settings.seed, now)
        self._victim = udp_socket(Address(VICTIM_HOST, 0))
        try:
            for address in self.settings.listen:
                self._sockets.append(udp_socket(address))
            if self.settings.control_socket is not None:
                answer = partial(answer_request, self)
                self._control = ControlServer(self.settings.control_socket, answer, MAX_REQUEST_BYTES)
                await self._control.start()
            self.journal = Journal(self.settings.log, self.log, now, self.settings.log_detail)
        except BaseException:
            await self._close()
            raise
        self._serve(now)
        for number, sock in enumerate(self._sockets):
            self._loop.add_reader(sock, self._on_readable, number, sock)
        self._ticks = asyncio.create_task(self._tick())
        listen = list(map(str, self.addresses))
        self.journal.event("relay_started", now, seed=self.settings.seed, listen=listen, attacks=self._attack_names())

    @property
    def addresses(self) -> list[Address]:
        """Where it listens."""
        return [Address(*sock.getsockname()[:2]) for sock in self._sockets]

    async def stop(self) -> None:
        """Stop without a word to the members."""
        self._ticks.cancel()
        await asyncio.gather(self._ticks, return_exceptions=True)
        for sock in self._sockets:
            self._loop.remove_reader(sock)
        statistics = self.statistics()
        await self._close()
        self.journal.event("relay_stopped", monotonic(), **statistics)
        self.journal.close()

    async def _close(self) -> None:
        for sock in (*self._sockets, self._victim):
            sock.close()
        if self._control is not None:
            await self._control.stop()

    def _serve(self, now: float) -> None:
        """A relay without sessions, bindings and handles."""
        self._open.clear()
        self._targets.clear()
        self._node = _LyingNode(self.settings.private_key, os.urandom, now)
        self._node.relay = self
        self._service = RelayService(
            self._node,
            os.urandom,
            monotonic,
            self.settings.server.limits,
            perform=self._perform,
            send=self._forward,
            send_from_new_port=self._send_from_new_port,
            on_event=lambda event, at: None,
        )
        forwarding = _NotedForwarding(self._forward, monotonic, self.settings.server.limits)
        forwarding.relay = self
        self._service.forwarding = forwarding
        self._service.set_members(self.settings.server.by_key, {}, now)
        self._housekeeping_at = now + HOUSEKEEPING_S

    # From the owner: see :class:`.Attacker`.

    def statistics(self) -> dict[str, object]:
        """The counters of this run, as plain data. The victim of false addresses is a stranger."""
        with suppress(OSError):  # empty, or closed
            while True:
                self._bytes_to_victim += len(self._victim.recv(RECEIVE_BYTES))
        return {
            "seconds": round(monotonic() - self._began_at, 3),
            "seed": self.settings.seed,
            "is_paused": self.channel.is_paused,
            "attacks": self._attack_names(),
            "members_up": [member.settings.name for member in self._service.members.values() if member.peer.is_up],
            "received": {str(direction): count for direction, count in self.received.items()},
            "sent": {str(direction): count for direction, count in self.sent.items()},
            "interventions": {
                f"{attack}: {operation}": count for (attack, operation), count in self.journal.counts.items()
            },
            "strangers": {"bytes_back": self._bytes_to_victim, "amplified": {}},
        }

    def pause(self) -> None:
        """Be an honest relay until :meth:`resume`."""
        self.channel.is_paused = True
        self.journal.event("relay_paused", monotonic())

    def resume(self) -> None:
        """End a pause."""
        self.channel.is_paused = False
        self.journal.event("relay_resumed", monotonic())

    def attack(self, texts: Sequence[str]) -> list[str]:
        """Replace the attacks by those that the texts select, and return their names.

        Raises:
            AttackError: unknown attack or wrong parameters. The former attacks continue.
        """
        former = self.channel.attacks
        self.channel.attacks = tuple(self._make([parse_attack(text, ALL_ATTACKS) for text in texts]))
        self.journal.event("attacks_changed", monotonic(), attacks=self._attack_names())
        if any(isinstance(attack, RelayAttack) and attack.reports_after for attack in former):
            self.report_all()
        return self._attack_names()

    def _make(self, specs: Sequence[AttackSpec]) -> list[AttackObject]:
        now = monotonic()
        return [
            spec.make(self.context, f"{self.settings.seed} {position}", now) for position, spec in enumerate(specs)
        ]

    def _attack_names(self) -> list[str]:
        return [attack.name for attack in self.channel.attacks]

    # From the attacks: see :class:`.AttackedRelay`.

    @property
    def victim(self) -> tuple[str, int]:
        """An address that is not a member's."""
        host, port = self._victim.getsockname()
        return host, port

    def is_connected(self, direction: Direction) -> bool:
        """Whether members have handles for this direction now."""
        return direction in self._targets

    def record(self, done: Intervention) -> None:
        """Count an attempt."""
        self.journal.add(done)

    def report_all(self) -> None:
        """Report to each member the handles of its peers, as after a bind."""
        handles: dict[tuple[str, Path], dict[bytes, list[int]]] = {}
        for (handle, path), direction in self._open.items():
            of_path = handles.setdefault((direction.receiver, path), {})
            of_path.setdefault(self.keys[direction.sender], []).append(handle)
        for (name, path), of_peers in handles.items():
            host, port = path.address[:2]
            for bound in bounds_of(host.partition("%")[0], port, of_peers):
                self._perform(self._node.send_record(self._peer(name), path, bound, monotonic()))

    def send_data(self, member: str, handle: int, inner: bytes) -> None:
        """Send data to a member with any handle."""
        for path in (path for direction, (_, path) in self._targets.items() if direction.receiver == member):
            self._send(wrap(handle, inner), path)
            return

    def send_frames(self, member: str, frame: bytes) -> None:
        """Send a frame in the relay's session with a member."""
        self._perform(self._node.send(self._peer(member), [frame], monotonic()))

    def claim_token(self, member: str, token: bytes) -> None:
        """Report that a token was sent from another port, and send it from the relay's own one."""
        peer = self._peer(member)
        for path in (state.path for state in peer.paths.states if state.works):
            self._send(token_datagram(token), path)
            self._perform(self._node.send_record(peer, path, FilterTested(token), monotonic()))

    def restart(self) -> None:
        """Forget all sessions, bindings and handles, as a process that was killed and started again."""
        now = monotonic()
        self.journal.event("relay_restarted", now)
        self._serve(now)

    def _peer(self, name: str) -> Peer:
        return self._service.members[self.keys[name]].peer

    # From the parts of the relay.

    def falsified(self, member: str, bound: Bound, now: float) -> Bound:
        """What the attacks report to a member instead."""
        for attack in () if self.channel.is_paused else self.channel.attacks:
            if isinstance(attack, Lie):
                bound = attack.report(member, bound, now)
        return bound

    def direction(self, sender: bytes, receiver: bytes) -> Direction:
        """From one member to another, by their keys."""
        return Direction(self._names[sender], self._names[receiver])

    def connect(self, direction: Direction, target: _Target) -> None:
        """A member has a handle for this direction."""
        self._open[target] = direction
        self._targets[direction] = target

    def disconnect(self, target: _Target) -> None:
        """A member has a handle no more."""
        direction = self._open.pop(target, None)
        if direction is not None and self._targets[direction] == target:
            del self._targets[direction]
            self._targets |= {other: left for left, other in self._open.items() if other == direction}

    # Datagrams.

    def _on_readable(self, number: int, sock: socket.socket) -> None:
        for _ in range(DATAGRAMS_PER_WAKE_UP):
            try:
                data, source = sock.recvfrom(RECEIVE_BYTES)
            except BlockingIOError:
                break
            except OSError:  # an earlier datagram was refused
                continue
            if data.startswith(_START):
                self._service.take(number, data, source)
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
        direction = self._open[target]
        self._targets[direction] = target
        self.received[direction] += 1
        self._act(self.channel.on_datagram(data[3:], direction, monotonic()))

    def _act(self, actions: Sequence[Action]) -> None:
        for action in actions:
            if isinstance(action, Intervention):
                self.journal.add(action)
            elif (target := self._targets.get(action.direction)) is not None:
                handle, path = target
                self.sent[action.direction] += 1
                self._send(wrap(handle, action.datagram), path)

    def _send(self, data: bytes, path: Path) -> None:
        with suppress(OSError):
            self._sockets[path.socket].sendto(data, path.address)

    def _send_from_new_port(self, data: bytes, path: Path) -> bool:
        """Returns False if an attack has answered the member."""
        now = monotonic()
        members = self._service.members.values()
        name = next(member.settings.name for member in members if member.peer.paths.find(path) is not None)
        for attack in () if self.channel.is_paused else self.channel.attacks:
            if isinstance(attack, LieAboutFilters) and attack.hides(name, token_of(data), now):
                return False
        with suppress(OSError):
            send_from_new_port(self._sockets[path.socket], data, path.address)
        return True

    # Time.

    async def _tick(self) -> None:
        while True:
            now = monotonic()
            self._perform(self._node.handle_timeout(now))
            if now >= self._housekeeping_at:
                self._housekeeping_at = now + HOUSEKEEPING_S
                self._service.do_housekeeping(now)
                self.journal.flush(now)
            self._act(self.channel.due(now))
            self._settle()
            await asyncio.sleep(TICK_S)

    def _settle(self) -> None:
        if self._service.is_due:
            self._service.settle(monotonic())
