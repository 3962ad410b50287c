"""The man in the middle as a daemon: sockets and one timer around an :class:`AttackChannel`.

Each peer of a link has a *listener*: an address that the peer believes to be the other peer. Datagrams that a peer
sends to its listener are meant for the other peer, which receives them from its own listener. The attacker's own
addresses, the *strangers*, are opened at their first use.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from time import monotonic

import structlog

from uavlinkd.endpoints.reader import DATAGRAMS_PER_WAKE_UP, RECEIVE_BYTES
from uavlinkd.endpoints.sockets import BindError, udp_socket
from uavlinkd.lab.mitm.amplification import Amplification
from uavlinkd.lab.mitm.attack import NEVER, Action, AttackContext, AttackObject, Direction, Intervention
from uavlinkd.lab.mitm.attack_requests import MAX_REQUEST_BYTES, answer_request
from uavlinkd.lab.mitm.attacks import AttackSpec, parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.journal import Journal
from uavlinkd.lab.mitm.proxy_settings import ProxySettings
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.ops.control import ControlServer
from uavlinkd.system.addresses import Address

LOOP_TICK_S = 0.001
"""An event loop may fire a timer up to one clock tick early."""

Sockaddr = tuple[str, int]


class Proxy:
    """A man in the middle between daemons. Call :meth:`start` first and :meth:`stop` last.

    Args:
        settings: the peers, links, attacks and radios.
        attacks: replace the attacks of the settings, unless None.
    """

    def __init__(self, settings: ProxySettings, attacks: Sequence[AttackObject] | None = None) -> None:
        self.settings = settings
        self.context: AttackContext = settings.context
        self.log = structlog.get_logger().bind(daemon="mitm")
        self.listeners: dict[Direction, Sockaddr] = {}
        """The address at which the sender reaches the receiver."""
        self.sent: Counter[Direction] = Counter()
        self.received: Counter[Direction] = Counter()
        self.stranger_bytes_sent: Counter[tuple[str, int]] = Counter()
        self.stranger_bytes_back: Counter[tuple[str, int]] = Counter()
        """By peer and stranger: bytes sent to the peer, and bytes received from it. Strangers are not validated."""
        self.amplification = Amplification()
        self.errors: Counter[str] = Counter()
        """Datagrams that were not forwarded, by reason."""
        self._attacks = attacks
        self._now = monotonic()
        self._sockets: dict[Direction, socket.socket] = {}
        self._strangers: dict[tuple[int, int], socket.socket] = {}
        self._addresses: dict[tuple[str, int], Sockaddr] = {}  # by peer and path
        self._is_fixed = {peer.name: peer.address is not None for peer in settings.peers}
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = NEVER
        self._control: ControlServer | None = None
        self.stopping = asyncio.Event()
        """Set by the request ``stop`` on the control socket."""

    async def start(self) -> None:
        """Bind all listeners and start forwarding.

        Raises:
            BindError: an address cannot be bound, or a peer's host name cannot be resolved.
            AttackError: these peers do not allow an attack.
            ControlError: the control socket cannot be used.
            OSError: the log file cannot be written.
        """
        self._began_at = self._now = monotonic()
        self._loop = asyncio.get_running_loop()
        attacks = self._make(self.settings.attacks) if self._attacks is None else self._attacks
        radios = self.settings.radio_of()
        self.channel = AttackChannel(self.context, attacks, radios, self.settings.seed, self._now)
        try:
            await self._resolve()
            self._bind()
            if self.settings.control_socket is not None:
                answer = partial(answer_request, self)
                self._control = ControlServer(self.settings.control_socket, answer, MAX_REQUEST_BYTES)
                await self._control.start()
            self.journal = Journal(self.settings.log, self.log, self._now, self.settings.log_detail)
        except BaseException:
            self._close_sockets()
            if self._control is not None:
                await self._control.stop()
            raise
        for direction, sock in self._sockets.items():
            self._loop.add_reader(sock, self._on_listener_readable, sock, direction)
        self.journal.event(
            "mitm_started",
            self._now,
            seed=self.settings.seed,
            listeners={str(direction): str(Address(*at)) for direction, at in self.listeners.items()},
            attacks=self._names(),
        )
        self._arm()

    async def stop(self) -> None:
        """Close the sockets and the log."""
        if self._timer is not None:
            self._timer.cancel()
        for sock in (*self._sockets.values(), *self._strangers.values()):
            self._loop.remove_reader(sock)
        statistics = self.statistics()
        self._close_sockets()
        if self._control is not None:
            await self._control.stop()
        self.journal.event("mitm_stopped", monotonic(), **statistics)
        self.journal.close()

    def _make(self, specs: Sequence[AttackSpec]) -> list[AttackObject]:
        return [
            spec.place(self.context, f"{self.settings.seed} {position}", self._now)
            for position, spec in enumerate(specs)
        ]

    async def _resolve(self) -> None:
        for peer in self.settings.peers:
            if peer.address is not None:
                try:
                    addresses = await self._loop.getaddrinfo(*peer.address.sockaddr, type=socket.SOCK_DGRAM)
                except OSError as error:
                    raise BindError(f"cannot resolve {peer.name} at {peer.address}: {error.strerror}") from None
                host, port = addresses[0][4][:2]
                for direction in self.context.directions:
                    if direction.sender == peer.name:
                        self._addresses[peer.name, direction.path] = str(host), int(port)

    def _bind(self) -> None:
        for direction, address in self.settings.listeners.items():
            sock = self._sockets[direction] = udp_socket(address)
            self.listeners[direction] = sock.getsockname()[:2]

    def _close_sockets(self) -> None:
        for sock in (*self._sockets.values(), *self._strangers.values()):
            sock.close()
        self._sockets.clear()
        self._strangers.clear()

    def attack(self, texts: Sequence[str]) -> list[str]:
        """Replace the attacks by those that the texts select, and return their names.

        Raises:
            AttackError: unknown attack or wrong parameters. The former attacks continue.
        """
        self._now = monotonic()
        self.change_attacks(self._make([parse_attack(text) for text in texts]))
        return self._names()

    def change_attacks(self, attacks: Sequence[AttackObject]) -> None:
        """Replace the attacks. Datagrams that the old ones hold are lost."""
        self.channel.attacks = tuple(attacks)
        self.journal.event("attacks_changed", monotonic(), attacks=self._names())
        self._arm()

    def change_radio(self, directions: str, settings: RadioSettings) -> None:
        """Replace the settings of radios. ``directions`` is ``both`` or ``A>B``. Datagrams in flight stay in flight.

        Raises:
            AttackError: there is no such direction.
            KeyError: a direction has no radio.
        """
        for direction in self.context.select(directions):
            self.channel.radios[direction].settings = settings
        self._arm()

    def pause(self) -> None:
        """Pass all datagrams unchanged until :meth:`resume`."""
        self.channel.is_paused = True
        self.journal.event("mitm_paused", monotonic())

    def resume(self) -> None:
        """End a pause."""
        self.channel.is_paused = False
        self.journal.event("mitm_resumed", monotonic())
        self._arm()

    def statistics(self) -> dict[str, object]:
        """The counters of this run, as plain data."""
        sent, back = self.stranger_bytes_sent, self.stranger_bytes_back
        return {
            "seconds": round(monotonic() - self._began_at, 3),
            "seed": self.settings.seed,
            "is_paused": self.channel.is_paused,
            "attacks": self._names(),
            "received": {str(direction): count for direction, count in self.received.items()},
            "sent": {str(direction): count for direction, count in self.sent.items()},
            "interventions": {
                f"{attack}: {operation}": count for (attack, operation), count in self.journal.counts.items()
            },
            "strangers": {
                "bytes_sent": sent.total(),
                "bytes_back": back.total(),
                "amplified": {
                    f"{peer} to {number}": excess for (peer, number), excess in self.amplification.excess.items()
                },
            },
            "radios": {str(direction): dict(radio.outcomes) for direction, radio in self.channel.radios.items()},
            "errors": dict(self.errors),
        }

    def _names(self) -> list[str]:
        return [attack.name for attack in self.channel.attacks]

    # Datagrams.

    def _on_listener_readable(self, sock: socket.socket, direction: Direction) -> None:
        now, end = monotonic(), (direction.sender, direction.path)
        for _ in range(DATAGRAMS_PER_WAKE_UP):
            try:
                datagram, source = sock.recvfrom(RECEIVE_BYTES)
            except BlockingIOError:
                break
            except OSError as error:  # an earlier datagram was refused
                self._count_error(error)
                continue
            if self._is_fixed[direction.sender]:
                if source[:2] != self._addresses[end]:
                    self.errors["unknown sender"] += 1
                    continue
            else:
                self._addresses[end] = source[:2]
            self.received[direction] += 1
            self._perform(self.channel.on_datagram(datagram, direction, now))
        self._arm()

    def _on_stranger_readable(self, sock: socket.socket, stranger: int) -> None:
        now = monotonic()
        for _ in range(DATAGRAMS_PER_WAKE_UP):
            try:
                datagram, source = sock.recvfrom(RECEIVE_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                self._count_error(error)
                continue
            peer = next((name for (name, _), at in self._addresses.items() if at == source[:2]), None)
            if peer is None:
                self.errors["unknown sender"] += 1
                continue
            self.stranger_bytes_back[peer, stranger] += len(datagram)
            self.amplification.received(peer, stranger, len(datagram), now)
            self._perform(self.channel.on_answer(datagram, peer, stranger, now))
        self._arm()

    def _perform(self, actions: Sequence[Action]) -> None:
        for action in actions:
            if isinstance(action, Intervention):
                self.journal.add(action)
                continue
            datagram, direction, stranger = action
            to = self._addresses.get((direction.receiver, direction.path))
            sock = self._sockets.get(direction.reverse) if to and stranger is None else None
            try:
                if to is not None and stranger is not None:
                    sock = self._stranger(stranger, to)
                if to is None or sock is None:
                    self.errors["unknown receiver"] += 1
                    continue
                sock.sendto(datagram, to)
            except OSError as error:
                self._count_error(error)
                continue
            if stranger is None:
                self.sent[direction] += 1
            else:
                self.stranger_bytes_sent[direction.receiver, stranger] += len(datagram)
                self.amplification.sent(direction.receiver, stranger, len(datagram), monotonic())

    def _stranger(self, number: int, to: Sockaddr) -> socket.socket:
        """The socket of a stranger. On loopback each stranger has its own address, elsewhere its own port."""
        family = socket.AF_INET6 if ":" in to[0] else socket.AF_INET
        sock = self._strangers.get((number, family))
        if sock is None:
            sock = socket.socket(family, socket.SOCK_DGRAM)
            sock.setblocking(False)
            if to[0].startswith("127."):
                with suppress(OSError):  # some systems lack the rest of 127.0.0.0/8; then it has its own port
                    sock.bind((f"127.0.{1 + number // 250}.{1 + number % 250}", 0))
            self._strangers[number, family] = sock
            self._loop.add_reader(sock, self._on_stranger_readable, sock, number)
        return sock

    def _count_error(self, error: OSError) -> None:
        self.errors[error.strerror or type(error).__name__] += 1

    def _arm(self) -> None:
        """Set the timer to the next deadline."""
        deadline = min(self.channel.next_deadline(), self.journal.next_flush())
        if deadline < self._timer_at:
            if self._timer is not None:
                self._timer.cancel()
            self._timer_at = deadline
            self._timer = self._loop.call_later(max(0.0, deadline - monotonic()) + LOOP_TICK_S, self._on_timer)

    def _on_timer(self) -> None:
        now = monotonic()
        self._timer_at = NEVER
        self._perform(self.channel.due(now))
        self.journal.flush(now)
        self._arm()
