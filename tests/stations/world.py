"""A tunnel of the daemon and a client, with a network between them, in virtual time."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from functools import partial
from itertools import count

from tests.stations.client import Client
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.stations import handshake, inner
from uavlinkd.stations.tunnel import Tunnel

THERE = ("203.0.113.7", 40001)


class World:
    """The two ends. ``delay`` decides about each datagram: seconds, or None for one that is lost."""

    def __init__(self, seed: int = 1, host: str = "10.66.0.2", daemon_host: str = "10.66.0.1") -> None:
        self.random = random.Random(seed)
        self.now = 100.0
        entropy = self.random.randbytes
        self.own = handshake.StationKey(entropy(32))
        self.client = Client(self.own.key.public, host, daemon_host)
        self.numbers = count(1)
        self.indices: dict[int, Tunnel] = {}
        self._ends = inner.Ends.of(host, daemon_host)
        self.tunnel = self._new_tunnel()
        self.there = THERE
        """Where the client is. What the daemon sends elsewhere is lost."""
        self.to_daemon: Callable[[bytes], float | None] = lambda datagram: 0.02
        self.to_client: Callable[[bytes], float | None] = lambda datagram: 0.02
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self.delivered: list[tuple[bytes, bool, float]] = []
        """Payloads at the daemon, whether they count as new, and when they came."""
        self.drops: list[DropReason] = []
        self.at_client: list[bytes] = []

    def timestamp(self) -> bytes:
        return (2**62 + next(self.numbers)).to_bytes(8, "big") + bytes(4)

    def _new_tunnel(self) -> Tunnel:
        arguments = self.client.key, self._ends, self.random.randbytes, self.indices, self.timestamp
        return Tunnel(self.own, *arguments)

    def restart_daemon(self) -> None:
        """The daemon ends and starts: it knows where the station was, and initiates there."""
        at = self.tunnel.address
        self.indices = {}
        self.tunnel = self._new_tunnel()
        self.tunnel.address = at
        self.from_daemon(self.tunnel.initiate(self.now))

    # The network.

    def at(self, seconds: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (seconds, next(self._order), action))

    def from_client(self, datagram: bytes) -> None:
        if (delay := self.to_daemon(datagram)) is not None:
            self.at(self.now + delay, partial(self.receive, datagram))

    def from_daemon(self, datagrams: list[bytes], to: tuple[str, int] | None = None) -> None:
        for datagram in datagrams if (to or self.tunnel.address) == self.there else ():
            if (delay := self.to_client(datagram)) is not None:
                self.at(self.now + delay, partial(self._at_client, datagram))

    def receive(self, datagram: bytes) -> None:
        """At the daemon, as the service does it."""
        try:
            match datagram[0]:
                case 1:
                    initiation = handshake.read_initiation(self.own, datagram)
                    self.from_daemon([self.tunnel.on_initiation(initiation, self.now)], self.there)
                case 2:
                    index = int.from_bytes(datagram[8:12], "little")
                    self.from_daemon(self.tunnel.on_response(datagram, index, self.now))
                case 4:
                    index = int.from_bytes(datagram[4:8], "little")
                    opened = self.tunnel.open(datagram, index, self.there, self.now)
                    content = inner.parse(opened.packet, self.tunnel.ends) if opened.packet else None
                    if isinstance(content, inner.Datagram):
                        is_new = opened.is_new(self.now)
                        self.delivered.append((content.payload, is_new, self.now))
                        self.tunnel.on_frames(self.now, is_new=is_new, has_commands=True)
                    elif isinstance(content, inner.Ping):
                        self.tunnel.on_answer(opened, content.token)
        except Drop as drop:
            self.drops.append(drop.reason)

    def _at_client(self, datagram: bytes) -> None:
        match datagram[0]:
            case 1:
                self.from_client(self.client.on_initiation(datagram))
            case 2 if self.client.awaits(datagram):
                self.client.on_response(datagram)
                self.from_client(self.client.data(b""))
            case 4 if self.client.knows(datagram):
                payload, answers = self.client.on_data(datagram)
                if payload:
                    self.at_client.append(payload)
                for answer in answers:
                    self.from_client(answer)

    # Time.

    def run(self, until: float) -> None:
        """Let everything happen that is due until then."""
        while True:
            next_event = self._events[0][0] if self._events else float("inf")
            moment = min(next_event, max(self.tunnel.next_at, self.now))
            if moment > until:
                break
            self.now = moment
            if next_event <= moment:
                heapq.heappop(self._events)[2]()
            else:
                self.from_daemon(self.tunnel.do_due(self.now))
                assert self.tunnel.next_at > self.now
        self.now = until

    def connect(self) -> None:
        """The station initiates, and its system confirms the session."""
        self.from_client(self.client.initiation())
        self.run(self.now + 0.2)
        assert self.tunnel.is_open

    def command(self, name: bytes) -> None:
        """The station's software sends something now."""
        self.from_client(self.client.udp(name))

    def commands(self, seconds: float, every: float = 0.5) -> None:
        """Commands with their time as the payload."""
        steps = int(seconds / every)
        for step in range(steps):
            at = self.now + step * every
            self.at(at, partial(self.command, repr(at).encode()))
        self.run(self.now + seconds)

    @property
    def ages(self) -> list[float]:
        """How old each command was that counted as new."""
        return [at - float(payload) for payload, is_new, at in self.delivered if is_new]
