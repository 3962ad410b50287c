"""The man in the middle as a daemon: sockets and one timer around a :class:`Channel`.

For each peer of a link there is a *face*: an address that stands for the other peer. What a peer sends to its face is
what it sends to the other; what the other is to get comes from the face that it knows. Addresses of the attacker's
own, the *strangers*, are opened when an attack first uses them.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from time import monotonic

import structlog

from uavlinkd.system.addresses import Address
from uavlinkd.ops.control import ControlServer
from uavlinkd.endpoints.sockets import DATAGRAMS_PER_WAKE_UP, RECEIVE_BYTES, BindError, udp_socket
from uavlinkd.lab.mitm.amplification import Amplification
from uavlinkd.lab.mitm.attack import NEVER, Action, AttackError, AttackObject, Intervention, Surroundings, Way
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.channel import Channel
from uavlinkd.lab.mitm.journal import Journal
from uavlinkd.lab.mitm.proxy_settings import ProxySettings

MAX_REQUEST_BYTES = 4096
"""To the control socket: several attacks, each with all that can be said of it."""
LOOP_TICK_S = 0.001
"""A loop may fire a timer up to one tick of its clock early."""

Sockaddr = tuple[str, int]


class Proxy:
    """One man in the middle. :meth:`start` it, and :meth:`stop` it in the end.

    Args:
        settings: between whom it stands.
        attacks: what stands in the way; None for the attacks that the settings name.
    """

    def __init__(self, settings: ProxySettings, attacks: Sequence[AttackObject] | None = None) -> None:
        self.settings = settings
        self.surroundings: Surroundings = settings.surroundings
        self.log = structlog.get_logger().bind(daemon="mitm")
        self.faces: dict[tuple[str, str], Sockaddr] = {}
        """By peer and by whom it reaches there."""
        self.sent: Counter[Way] = Counter()
        self.received: Counter[Way] = Counter()
        self.stranger_bytes_sent: Counter[tuple[str, int]] = Counter()
        self.stranger_bytes_back: Counter[tuple[str, int]] = Counter()
        """By peer and stranger: what went there, what came from there. Each stranger is an unvalidated address."""
        self.amplification = Amplification()
        self.troubles: Counter[str] = Counter()
        """Datagrams that went nowhere, by the reason."""
        self._given = attacks
        self._now = monotonic()
        self._sockets: dict[tuple[str, str], socket.socket] = {}
        self._strangers: dict[tuple[int, int], socket.socket] = {}
        self._addresses: dict[str, Sockaddr] = {}
        self._is_fixed = {each.name: each.address is not None for each in settings.peers}
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = NEVER
        self._control: ControlServer | None = None
        self.stopping = asyncio.Event()
        """Set when the control socket asked for the end."""

    # Life.

    async def start(self) -> None:
        """Bind every face, then stand in the way.

        Raises:
            BindError: an address that cannot be listened on, or a peer's name that cannot be resolved.
            AttackError: an attack that these peers do not allow.
            ControlError: a control socket that cannot be used.
            OSError: a log file that cannot be written.
        """
        self._began_at = self._now = monotonic()
        self._loop = asyncio.get_running_loop()
        attacks = self._made() if self._given is None else self._given
        radios = self.settings.radio_of()
        self.channel = Channel(self.surroundings, attacks, radios, self.settings.seed, self._now)
        try:
            await self._resolve()
            self._bind()
            if self.settings.control_socket is not None:
                self._control = ControlServer(self.settings.control_socket, self._answer, MAX_REQUEST_BYTES)
                await self._control.start()
            self.journal = Journal(self.settings.log, self.log, self._now, self.settings.log_detail)
        except BaseException:
            self._close_sockets()
            if self._control is not None:
                await self._control.stop()
            raise
        for (peer, other), sock in self._sockets.items():
            self._loop.add_reader(sock, self._on_face_readable, sock, Way(peer, other))
        self.journal.event(
            "mitm_started",
            self._now,
            seed=self.settings.seed,
            faces={f"{peer} reaches {other}": str(Address(*at)) for (peer, other), at in self.faces.items()},
            attacks=self._names(),
        )
        self._arm()

    async def stop(self) -> None:
        """Close everything, and finish the log."""
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

    def _made(self) -> list[AttackObject]:
        return [
            spec.make(self.surroundings, f"{self.settings.seed} {position}", self._now)
            for position, spec in enumerate(self.settings.attacks)
        ]

    async def _resolve(self) -> None:
        for peer in self.settings.peers:
            if peer.address is not None:
                try:
                    found = await self._loop.getaddrinfo(*peer.address.sockaddr, type=socket.SOCK_DGRAM)
                except OSError as error:
                    raise BindError(f"cannot find {peer.name} at {peer.address}: {error.strerror}") from None
                host, port = found[0][4][:2]
                self._addresses[peer.name] = str(host), int(port)

    def _bind(self) -> None:
        for link in self.settings.links:
            for peer, other, address in zip(link.peers, link.peers[::-1], link.listen, strict=True):
                sock = udp_socket(address)
                self._sockets[peer, other] = sock
                self.faces[peer, other] = sock.getsockname()[:2]

    def _close_sockets(self) -> None:
        for sock in (*self._sockets.values(), *self._strangers.values()):
            sock.close()
        self._sockets.clear()
        self._strangers.clear()

    # While it runs.

    def change_attacks(self, attacks: Sequence[AttackObject]) -> None:
        """Others from now on. What the old ones hold is lost."""
        self.channel.attacks = tuple(attacks)
        self.journal.event("attacks_changed", monotonic(), attacks=self._names())
        self._arm()

    def pause(self) -> None:
        """Let everything pass, until :meth:`resume`."""
        self.channel.is_paused = True
        self.journal.event("mitm_paused", monotonic())

    def resume(self) -> None:
        """Attack again."""
        self.channel.is_paused = False
        self.journal.event("mitm_resumed", monotonic())
        self._arm()

    def statistics(self) -> dict[str, object]:
        """What was seen and done so far; plain data."""
        sent, back = self.stranger_bytes_sent, self.stranger_bytes_back
        return {
            "seconds": round(monotonic() - self._began_at, 3),
            "seed": self.settings.seed,
            "is_paused": self.channel.is_paused,
            "attacks": self._names(),
            "received": {str(way): count for way, count in self.received.items()},
            "sent": {str(way): count for way, count in self.sent.items()},
            "interventions": {f"{attack}: {what}": count for (attack, what), count in self.journal.counts.items()},
            "strangers": {
                "bytes_sent": sent.total(),
                "bytes_back": back.total(),
                "amplified": {
                    f"{peer} to {number}": excess for (peer, number), excess in self.amplification.excess.items()
                },
            },
            "radios": {str(way): dict(radio.fates) for way, radio in self.channel.radios.items()},
            "troubles": dict(self.troubles),
        }

    def _names(self) -> list[str]:
        return [attack.name for attack in self.channel.attacks]

    def _answer(self, request: str) -> dict[str, object] | None:
        match request.split():
            case ["statistics"]:
                return self.statistics()
            case ["pause"]:
                self.pause()
            case ["resume"]:
                self.resume()
            case ["stop"]:
                self.stopping.set()
            case ["attack", first, *others]:
                return self._attack([first, *others])
            case _:
                return None
        return {"done": request}

    def _attack(self, words: list[str]) -> dict[str, object]:
        try:
            specs = () if words == ["none"] else tuple(map(parse_attack, words))
            self._now = monotonic()
            self.settings = replace(self.settings, attacks=specs)
            self.change_attacks(self._made())
        except AttackError as error:
            return {"refused": str(error)}
        return {"done": "attack", "attacks": self._names()}

    # Datagrams.

    def _on_face_readable(self, sock: socket.socket, way: Way) -> None:
        now = monotonic()
        for _ in range(DATAGRAMS_PER_WAKE_UP):
            try:
                datagram, source = sock.recvfrom(RECEIVE_BYTES)
            except BlockingIOError:
                break
            except OSError as error:  # an earlier datagram found nobody there
                self._trouble(error)
                continue
            if self._is_fixed[way.sender]:
                if source[:2] != self._addresses[way.sender]:
                    self.troubles["from nobody we know"] += 1
                    continue
            else:
                self._addresses[way.sender] = source[:2]
            self.received[way] += 1
            self._perform(self.channel.on_datagram(datagram, way, now))
        self._arm()

    def _on_stranger_readable(self, sock: socket.socket, stranger: int) -> None:
        now = monotonic()
        for _ in range(DATAGRAMS_PER_WAKE_UP):
            try:
                datagram, source = sock.recvfrom(RECEIVE_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                self._trouble(error)
                continue
            peer = next((name for name, at in self._addresses.items() if at == source[:2]), None)
            if peer is None:
                self.troubles["from nobody we know"] += 1
                continue
            self.stranger_bytes_back[peer, stranger] += len(datagram)
            self.amplification.came_back(peer, stranger, len(datagram), now)
            self._perform(self.channel.on_answer(datagram, peer, stranger, now))
        self._arm()

    def _perform(self, actions: Sequence[Action]) -> None:
        for action in actions:
            if isinstance(action, Intervention):
                self.journal.add(action)
                continue
            datagram, way, stranger = action
            to = self._addresses.get(way.receiver)
            sock = self._sockets.get((way.receiver, way.sender)) if to and stranger is None else None
            try:
                if to is not None and stranger is not None:
                    sock = self._stranger(stranger, to)
                if to is None or sock is None:
                    self.troubles["to nobody we know"] += 1
                    continue
                sock.sendto(datagram, to)
            except OSError as error:
                self._trouble(error)
                continue
            if stranger is None:
                self.sent[way] += 1
            else:
                self.stranger_bytes_sent[way.receiver, stranger] += len(datagram)
                self.amplification.sent(way.receiver, stranger, len(datagram), monotonic())

    def _stranger(self, number: int, to: Sockaddr) -> socket.socket:
        """The socket of a stranger. On loopback each has an address of its own, elsewhere a port of its own."""
        family = socket.AF_INET6 if ":" in to[0] else socket.AF_INET
        sock = self._strangers.get((number, family))
        if sock is None:
            sock = socket.socket(family, socket.SOCK_DGRAM)
            sock.setblocking(False)
            if to[0].startswith("127."):
                with suppress(OSError):  # not every system has all of 127.0.0.0/8; a port of its own will do
                    sock.bind((f"127.0.{1 + number // 250}.{1 + number % 250}", 0))
            self._strangers[number, family] = sock
            self._loop.add_reader(sock, self._on_stranger_readable, sock, number)
        return sock

    def _trouble(self, error: OSError) -> None:
        self.troubles[error.strerror or type(error).__name__] += 1

    # Time.

    def _arm(self) -> None:
        """Have the one timer fire at the next deadline."""
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
