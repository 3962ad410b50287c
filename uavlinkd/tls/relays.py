"""Relays that are reached by TLS, where UDP does not pass. uavlinkd/protocol/README.md, section 23.

Each URL has one socket number and one path. UDP comes first: a connection is made when its relay has not answered by
UDP for :data:`UDP_SILENT_S`, and ends when it has done so again for :data:`UDP_BACK_S`.
"""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Callable, Iterable
from contextlib import suppress
from math import inf
from random import SystemRandom
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import PeerAddress
from uavlinkd.daemon.features import AddSender, PathKind, Reachable
from uavlinkd.daemon.networks import NetworkBudget, Receive
from uavlinkd.io.ports import failure_name
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.ops.line_limits import LineLimits
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.path import Path, SocketAddress
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.peer import Peer
from uavlinkd.system.clock import monotonic
from uavlinkd.system.error_meanings import CONNECTED
from uavlinkd.system.stall import StallWatch
from uavlinkd.system.tasks import keep_running
from uavlinkd.tls.connect import Connector
from uavlinkd.tls.stream import OPEN_S, WebStream

WEB_NETWORK: Final = "TLS"
"""What people see as the network of a connection."""
UDP_FIRST_S: Final = 1.0
"""Four times as long as RFC 8305 lets an address try alone: a mobile network that sleeps answers late."""
UDP_SILENT_S: Final = 0.5
"""After it worked, from when a question was not answered in time: with frames, about 1 s after the last datagram."""
UDP_BACK_S: Final = 10.0
"""So a network that passes UDP now and then does not cost a connection each time."""
LEAVE_S: Final = 2.5
"""Before it is closed, a connection only receives for so long: peers notice that, and use UDP."""
LOOK_S: Final = 0.25
RETRY_S: Final = 0.5
"""Between the beginnings of two attempts, at most;"""
RETRY_AWAY_S: Final = 4.0
"""and after :data:`AWAY_S` without the relay."""
AWAY_S: Final = 60.0
SPREAD: Final = 0.2
"""Each wait is shorter by up to this share, so that the members of a relay that restarts do not come at once."""
ANSWER_S: Final = 3.0
"""A connection that opened is kept alone for so long, until the relay answers along it."""
UDP_WORKS: Final = "udp_works"
PROBE_S: Final = 3.0
"""The command that asks for a probe waits for 5 s."""
WAIT_S: Final = 0.1
"""Frames look so often whether a connection takes them again, or does not answer, besides when it reports room."""
_RNG: Final = SystemRandom()


class WebGate(Bucket):
    """Lets frames out when a connection sends them at once: they wait here, where old ones are dropped."""

    __slots__ = ("_room",)
    keeps_order = True

    def __init__(self, room: Callable[[], float]) -> None:
        super().__init__(0.0, 0.0, 1.0)
        self.rate = float(1 << 30)  # that of the connection is not known
        self._room = room

    def level(self, now: float) -> float:
        return self._room()

    def spend(self, wire_bytes: float, now: float) -> None:
        """The connection itself knows what it was given."""

    def wait_s(self, price: float, now: float) -> float:
        return 0.0 if self.level(now) >= price else WAIT_S


class WebBudget(NetworkBudget):
    """What a connection takes: not known in advance."""

    def __init__(self, room: Callable[[], float]) -> None:
        self.bits_s = 0
        self.core_bits_s = 0.0
        self.all = self.copies = WebGate(room)

    def charge(self, datagram: bytes, path: Path, now: float) -> None:
        """Nothing is charged."""


class WebRelay:
    """One URL of a relay. ``number``: that of its socket."""

    def __init__(
        self,
        written: PeerAddress,
        add: AddSender,
        node: Node,
        stall: StallWatch,
        log: FilteringBoundLogger,
        on_room: Callable[[], None] = lambda: None,
    ) -> None:
        self.written = written
        self.number = add(self.send, WebBudget(self._room))
        self.path = Path(self.number, (str(written), 0))
        self._connector = Connector(written.address.host, written.address.port, self.path.host, stall)
        self._error = ""
        self._node = node
        self._log = log
        self._limits = LineLimits()
        self._on_room = on_room
        self._receive: Receive = lambda *_: None
        self._on_change: Callable[[], None] = lambda: None
        self._stream: WebStream | None = None
        self._ended = asyncio.Event()
        self._peer: Peer | None = None
        self._task: asyncio.Task[None] | None = None
        self._is_leaving = False  # the connection only receives
        self._udp_silent_at = 0.0  # it is silent from then on, if it does not work before
        self._began_at = -inf  # the last attempt
        self._spread = 1.0
        self._answer_by = self._answered_at = monotonic()
        node.facts.add_stream(self.number)

    @property
    def state(self) -> str:
        """``connected``, ``not connected``, or why the last try failed."""
        return CONNECTED if self._stream is not None else self._error or "not connected"

    def start(self, peer: Peer, receive: Receive, on_change: Callable[[], None], *, has_udp: bool = False) -> None:
        """Connect whenever this relay does not answer by UDP. ``has_udp``: it has an address for that."""
        self._peer, self._receive, self._on_change = peer, receive, on_change
        self._udp_silent_at = monotonic() + UDP_FIRST_S if has_udp else -inf
        if self._task is None:
            self._task = keep_running(self._keep, f"the connection to {self.written}")

    def stop(self) -> None:
        """End the connection, and make no other one."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
        if self._stream is not None:
            self._stream.finish()  # the session has just been closed

    def send(self, datagram: bytes, _address: SocketAddress) -> int:
        """As a socket's ``sendto``."""
        if self._stream is None:
            raise OSError(errno.ENOTCONN, "there is no connection")
        if not self._is_leaving:
            self._stream.send(datagram)
        return len(datagram)

    def report_state(self) -> None:
        """Tell the core whether there is a connection."""
        if self._stream is None or self._is_leaving:
            self._node.set_socket_state(self.number, monotonic(), is_up=False)

    def _room(self) -> float:
        return 0.0 if self._stream is None else self._stream.room(monotonic())

    # The connection.

    async def probe(self) -> dict[str, str]:
        """Connect once more. ``error``: why that is not possible; ``proxy``: the one of the environment."""
        proxy = error = ""
        try:
            proxy = self._connector.proxy
            async with asyncio.timeout(PROBE_S):
                (await self._connector.upgrade(await self._connector.open(), PROBE_S)).lose("probed")
        except OSError as failure:  # TimeoutError too
            error = _name(failure)
        return {"error": error, "proxy": proxy}

    async def _keep(self) -> None:
        """Make connections. One that became silent stays beside the attempts: it may recover before they succeed."""
        while True:
            await self._until_wanted()
            self._began_at, self._spread = monotonic(), _RNG.uniform(1.0 - SPREAD, 1.0)
            try:
                stream = await self._connector.upgrade(await self._connector.open(), OPEN_S)
            except OSError as error:
                before, self._error = self._error, _name(error)
                if self._error != before and (omitted := self._take_line()) is not None:
                    url = self.path.host
                    self._log.warning("relay_not_connected", address=url, reason=self._error, **omitted)
            else:
                if self._works:
                    stream.lose("not_needed")
                else:
                    self._answer_by = monotonic() + ANSWER_S
                    self._use(stream)

    @property
    def _wait_s(self) -> float:
        """Between the beginnings of the last attempt and the next one."""
        return self._spread * (RETRY_AWAY_S if self._began_at > self._answered_at + AWAY_S else RETRY_S)

    async def _until_wanted(self) -> None:
        """Until an attempt is due: the relay answers neither by UDP nor along the connection."""
        udp_since = inf
        while True:
            now = monotonic()
            udp_since = min(udp_since, now) if self._udp_works else inf
            if udp_since <= now:
                self._udp_silent_at = now + UDP_SILENT_S
            if self._works:
                self._answered_at, self._answer_by = now, now + LOOK_S
            due_at = max(self._began_at + self._wait_s, self._udp_silent_at)
            if self._stream is not None:
                due_at = max(due_at, self._answer_by)
                if now >= udp_since + UDP_BACK_S:
                    await self._leave(self._stream)
                    continue
            if now >= due_at:
                return
            await self._pause(min(due_at - now, LOOK_S))

    async def _leave(self, stream: WebStream) -> None:
        """UDP works again."""
        self._is_leaving = True
        self._node.set_socket_state(self.number, monotonic(), is_up=False)
        await self._pause(LEAVE_S)
        stream.lose(UDP_WORKS)

    async def _pause(self, seconds: float) -> None:
        """Wait so long, or until the connection ends."""
        self._ended.clear()
        with suppress(TimeoutError):
            await asyncio.wait_for(self._ended.wait(), seconds)

    @property
    def _works(self) -> bool:
        return any(state.path == self.path for state in self._working)

    @property
    def _udp_works(self) -> bool:
        return any(state.path.is_udp and not state.is_silent for state in self._working)

    @property
    def _working(self) -> list[PathState]:
        """The paths along which the relay answers."""
        assert self._peer is not None, "started"
        return [state for state in self._peer.paths.states if state.works] if self._peer.is_up else []

    def _use(self, stream: WebStream) -> None:
        if self._stream is not None:
            self._stream.lose("silent")
        self._stream, stream.handler = stream, self
        self.on_open()

    # As the handler of the stream.

    def on_open(self) -> None:
        """It is used."""
        self._is_leaving, self._error = False, ""
        self._node.set_socket_state(self.number, monotonic(), is_up=True)
        if (omitted := self._take_line()) is not None:
            self._log.info("relay_connected", address=self.path.host, **omitted)
        self._on_change()

    def _take_line(self) -> dict[str, int] | None:
        omitted = self._limits.take("web", self.path.host, monotonic())
        if omitted is None:
            self._limits.omit("web", self.path.host)
        return omitted

    def on_datagrams(self, datagrams: list[bytes], now: float, epoch: int) -> None:
        """Messages came in one read."""
        address = self.path.address
        self._receive(self.number, [(datagram, address) for datagram in datagrams], now, epoch, 0.0)

    def on_room(self) -> None:
        """Frames that wait may leave."""
        self._on_room()

    def on_lost(self, reason: str) -> None:
        """It ended."""
        self._stream = None
        self._ended.set()
        self._node.set_socket_state(self.number, monotonic(), is_up=False)
        self._error = "" if reason == UDP_WORKS else reason
        if self._task is not None:
            if (omitted := self._take_line()) is not None:
                self._log.info("relay_disconnected", address=self.path.host, reason=reason, **omitted)
            self._on_change()


class WebRelays(PathKind):
    """All URLs of relays. Each keeps the number of its socket while the daemon runs."""

    def __init__(self, node: Node, stall: StallWatch, log: FilteringBoundLogger) -> None:
        self._relays: dict[PeerAddress, WebRelay] = {}
        self._shell = node, stall, log
        self._add: AddSender
        self._receive: Receive
        self._on_change: Callable[[], None]
        self._on_room: Callable[[], None]

    def open(self, add: AddSender) -> None:
        """Reserve the numbers with ``add``, later."""
        self._add = add

    def start(self, receive: Receive, on_change: Callable[[], None], on_room: Callable[[], None]) -> None:
        """Where datagrams go from now on."""
        self._receive, self._on_change, self._on_room = receive, on_change, on_room

    def path_to(self, written: PeerAddress) -> Path | None:
        """The path to a URL."""
        if not written.address.resource:
            return None
        if written not in self._relays:
            self._relays[written] = WebRelay(written, self._add, *self._shell, lambda: self._on_room())  # noqa: PLW0108  it is set later
        return self._relays[written].path

    def network_name(self, number: int) -> str | None:
        """``TLS`` for all of them."""
        return WEB_NETWORK if any(relay.number == number for relay in self._relays.values()) else None

    def follow(self, link: Reachable) -> None:
        """Connect to the URLs of a relay, whenever it does not answer by UDP."""
        addresses = link.config.addresses
        has_udp = any(not (written.address.resource or written.is_serial) for written in addresses)
        for relay in self._of(addresses):
            relay.start(link.peer, self._receive, self._on_change, has_udp=has_udp)

    def unfollow(self, link: Reachable) -> None:
        """Do not connect to them any more."""
        for relay in self._of(link.config.addresses):
            relay.stop()

    def close(self) -> None:
        """End all connections."""
        for relay in self._relays.values():
            relay.stop()

    def report_state(self) -> None:
        """Tell the core which connections there are."""
        for relay in self._relays.values():
            relay.report_state()

    def states(self, addresses: Iterable[PeerAddress]) -> dict[str, str]:
        """By URL: ``connected``, ``not connected``, or why that failed."""
        return {relay.path.host: relay.state for relay in self._of(addresses)}

    async def probe(self) -> dict[str, dict[str, str]]:
        """Connect once more to each URL: :meth:`WebRelay.probe`."""
        relays = list(self._relays.values())
        results = await asyncio.gather(*(relay.probe() for relay in relays))
        return {relay.path.host: result for relay, result in zip(relays, results, strict=True)}

    def _of(self, addresses: Iterable[PeerAddress]) -> list[WebRelay]:
        return [self._relays[written] for written in addresses if written in self._relays]


def _name(error: OSError) -> str:
    return str(error) if error.errno is None and str(error) else failure_name(error)
