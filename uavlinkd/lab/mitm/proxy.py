"""The man in the middle as a daemon: sockets and one timer around an :class:`AttackChannel`.

Each peer of a link has a *listener*: an address that the peer believes to be the other peer. Datagrams that a peer
sends to its listener are meant for the other peer, which receives them from its own listener. The attacker's own
addresses, the *strangers*, are opened at their first use. A peer that sends more to a stranger than it received from
there can flood an address: amplification.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from time import monotonic
from typing import Any

from uavlinkd.io.reader import DATAGRAMS_PER_WAKE_UP, RECEIVE_BYTES
from uavlinkd.io.sockets import BindError, udp_socket
from uavlinkd.lab.mitm.attack import Action, AttackContext, AttackError, Direction, Intervention
from uavlinkd.lab.mitm.attack_service import ChannelService
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.proxy_settings import ProxySettings
from uavlinkd.ops.control import ControlServer
from uavlinkd.system.addresses import Address
from uavlinkd.system.tasks import on_signal

REQUESTS = '"statistics", "stop", "attack none" or "attack NAME,key=value ..."'
CREDIT_S = 10.0
"""How long a datagram counts as a request. Without a limit, a thousand unanswered datagrams would hide a thousand
answers of twice the size. 10 s is enough for a busy machine."""


class Amplification:
    """Compares the bytes received by a stranger with the bytes it sent within :data:`CREDIT_S` before, per peer.

    A stranger is an address of the attacker. It is not validated, so a peer may send it as many bytes as it received
    from there. Times are monotonic seconds. The rate of the attack bounds the memory.
    """

    def __init__(self) -> None:
        self.excess: Counter[tuple[str, int]] = Counter()
        """By peer and stranger: bytes received beyond those recently sent."""
        self.bytes_sent = self.bytes_back = 0
        """Of all strangers: to peers, and from peers."""
        self._credits: dict[tuple[str, int], deque[list[float]]] = {}  # time, remaining bytes

    def sent(self, peer: str, stranger: int, size: int, now: float) -> None:
        """The stranger sent ``size`` bytes to the peer."""
        self.bytes_sent += size
        unanswered = self._credits.setdefault((peer, stranger), deque())
        self._expire(unanswered, now)
        unanswered.append([now, size])

    def received(self, peer: str, stranger: int, size: int, now: float) -> None:
        """The peer sent ``size`` bytes to the stranger. They use up the oldest sent bytes first."""
        self.bytes_back += size
        unanswered = self._credits.get((peer, stranger), deque())
        self._expire(unanswered, now)
        left = float(size)
        while left and unanswered:
            used = min(left, unanswered[0][1])
            unanswered[0][1] -= used
            left -= used
            if not unanswered[0][1]:
                unanswered.popleft()
        if left:
            self.excess[peer, stranger] += int(left)

    @staticmethod
    def _expire(unanswered: deque[list[float]], now: float) -> None:
        while unanswered and now - unanswered[0][0] > CREDIT_S:
            unanswered.popleft()


Sockaddr = tuple[str, int]


def received(
    sock: socket.socket, on_error: Callable[[OSError], object] = lambda error: None
) -> Iterator[tuple[bytes, Any]]:
    """The waiting datagrams with their sources, at most :data:`DATAGRAMS_PER_WAKE_UP`."""
    for _ in range(DATAGRAMS_PER_WAKE_UP):
        try:
            datagram, source = sock.recvfrom(RECEIVE_BYTES)
        except BlockingIOError:
            return
        except OSError as error:  # an earlier datagram was refused
            on_error(error)
            continue
        yield datagram, source


class Proxy(ChannelService):
    """A man in the middle between daemons."""

    kind = "mitm"

    def __init__(self, settings: ProxySettings) -> None:
        super().__init__(settings.seed)
        self.settings = settings
        self.stopping = asyncio.Event()
        self._control: ControlServer | None = None
        self.context: AttackContext = settings.context
        self.listeners: dict[Direction, Sockaddr] = {}
        """The address at which the sender reaches the receiver."""
        self.sent: Counter[Direction] = Counter()
        self.received: Counter[Direction] = Counter()
        self.amplification = Amplification()
        self.errors: Counter[str] = Counter()
        """Datagrams that were not forwarded, by reason."""
        self._sockets: dict[Direction, socket.socket] = {}
        self._strangers: dict[tuple[int, int], socket.socket] = {}
        self._addresses: dict[tuple[str, int], Sockaddr] = {}  # by peer and path
        self._is_fixed = {peer.name: peer.address is not None for peer in settings.peers}

    async def start(self) -> None:
        self._began_at = monotonic()
        attacks = self.make(self.settings.attacks)
        radios = self.settings.radio_of()
        self.channel = AttackChannel(self.context, attacks, radios, self.settings.seed, self._began_at)
        try:
            await self._resolve()
            self._bind()
            if self.settings.control_socket is not None:
                self._control = ControlServer(self.settings.control_socket, self.answer)
                await self._control.start()
        except BaseException:
            await self._close()
            raise
        loop = asyncio.get_running_loop()
        for direction, sock in self._sockets.items():
            loop.add_reader(sock, self._on_listener_readable, sock, direction)
        listeners = {str(direction): str(Address(*at)) for direction, at in self.listeners.items()}
        self.event("started", seed=self.seed, listeners=listeners, attacks=self.names())
        self.arm()

    async def _resolve(self) -> None:
        for peer in self.settings.peers:
            if peer.address is not None:
                try:
                    addresses = await asyncio.get_running_loop().getaddrinfo(
                        peer.address.host, peer.address.port, type=socket.SOCK_DGRAM
                    )
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

    async def _close(self) -> None:
        for sock in (*self._sockets.values(), *self._strangers.values()):
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()
        self._sockets.clear()
        self._strangers.clear()
        if self._control is not None:
            await self._control.stop()

    async def run(self, seconds: float | None) -> None:
        """Start, run until SIGTERM, SIGINT, the request ``stop``, or for ``seconds``, and stop.

        Raises what :meth:`start` raises.
        """
        for name in ("SIGTERM", "SIGINT"):
            on_signal(name, self.stopping.set)
        await self.start()
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self.stopping.wait()
        finally:
            await self.stop()

    def answer(self, request: str) -> dict[str, object]:
        """Do what a request on the control socket asks, and return the answer."""
        words = request.split()
        try:
            match words:
                case ["statistics"]:
                    return self.statistics()
                case ["stop"]:
                    self.stopping.set()
                case ["attack", *texts] if texts:
                    return {"done": "attack", "attacks": self.attack([] if texts == ["none"] else texts)}
                case _:
                    raise AttackError(f"there is no request {' '.join(words)!r}: write {REQUESTS}")
        except ValueError as error:
            return {"refused": str(error)}
        return {"done": request}

    def statistics(self) -> dict[str, object]:
        excess = self.amplification.excess.items()
        return {
            **super().statistics(),
            "received": {str(direction): count for direction, count in self.received.items()},
            "sent": {str(direction): count for direction, count in self.sent.items()},
            "strangers": {
                "bytes_sent": self.amplification.bytes_sent,
                "bytes_back": self.amplification.bytes_back,
                "amplified": {f"{peer} to {number}": count for (peer, number), count in excess},
            },
            "radios": {str(direction): dict(radio.outcomes) for direction, radio in self.channel.radios.items()},
            "errors": dict(self.errors),
        }

    # Datagrams.

    def _on_listener_readable(self, sock: socket.socket, direction: Direction) -> None:
        now, end = monotonic(), (direction.sender, direction.path)
        for datagram, source in received(sock, self._count_error):
            if not self._is_fixed[direction.sender]:
                self._addresses[end] = source[:2]
            elif source[:2] != self._addresses[end]:
                self.errors["unknown sender"] += 1
                continue
            self.received[direction] += 1
            self._perform(self.channel.on_datagram(datagram, direction, now))
        self.arm()

    def _on_stranger_readable(self, sock: socket.socket, stranger: int) -> None:
        now = monotonic()
        for datagram, source in received(sock, self._count_error):
            peer = next((name for (name, _), at in self._addresses.items() if at == source[:2]), None)
            if peer is None:
                self.errors["unknown sender"] += 1
                continue
            self.amplification.received(peer, stranger, len(datagram), now)
            self._perform(self.channel.on_answer(datagram, peer, stranger, now))
        self.arm()

    def _perform(self, actions: Sequence[Action]) -> None:
        for action in actions:
            if isinstance(action, Intervention):
                self.count(action)
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
            asyncio.get_running_loop().add_reader(sock, self._on_stranger_readable, sock, number)
        return sock

    def _count_error(self, error: OSError) -> None:
        self.errors[error.strerror or type(error).__name__] += 1

    def next_deadline(self) -> float:
        return self.channel.next_deadline()

    def act(self, now: float) -> None:
        self._perform(self.channel.due(now))
