"""What TCP and serial ports share: frames into and out of byte streams, and a bounded wait for a slow other side.

What the kernel does not take at once waits in a buffer of its connection's own. When that is full the oldest frame
is dropped; a frame that waited too long is dropped whatever room there is, because what it says is no longer so. A
frame of which some bytes have gone is finished first: the other side could not find the next one's start.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Sequence
from math import inf
from typing import Protocol

import structlog

from uavlinkd.clock import monotonic
from uavlinkd.endpoints.ports import LocalPort, PortHandler, failure_name
from uavlinkd.mavlink.delivery import Source
from uavlinkd.mavlink.frames import MAX_GAP_S, Frame, SplitCounters, StreamSplitter
from uavlinkd.stall import STALE, Backlog

MAX_AGE_S = 1.0
"""A frame that waited longer than this for its turn is not sent any more."""
OUTGOING_BYTES = 65536
"""Held back for one connection: a second of the fastest telemetry, several seconds of the usual."""
READ_BYTES = 4096
"""Read of one connection in a wake-up; then the others have their turn. The costliest bytes take some 10 ms."""
STALLED_S = 30.0
"""A connection that took no byte for this long is closed, so that what nobody reads is not held for ever."""
LASTED_S = 60.0
"""An endpoint that was open for so long and then is not is news; one that comes and goes fills no log."""
ROOM_POLL_S = 0.01
"""How soon to look again where the kernel has room and it is we who leave it empty: it reports nothing then."""

DISCONNECTED = "disconnected"

_MEANINGS = {
    "ENOENT": "there is no such device now",
    "EACCES": "this user may not open it: add it to the device's group, often dialout",
    "EPERM": "this service may not open it: see DeviceAllow in its unit",
    "EBUSY": "another program has it open: end it (ModemManager takes new serial ports)",
    "ECONNREFUSED": "nobody listens there now",
    "connect_timeout": "nothing answers there now",
    "not_resolved": "its name has no address now",
}
"""What a person should understand by the reason for which an endpoint is not open. It is tried again, for ever."""


class Channel(Protocol):
    """The kernel's side of one connection. Nothing of it blocks."""

    def fileno(self) -> int:
        """For the event loop."""

    def read(self, size: int) -> bytes:
        """What is there, up to ``size`` bytes; none at the end. ``BlockingIOError`` where nothing is there now."""

    def write(self, data: bytes) -> int:
        """Hand bytes over; how many were taken. ``BlockingIOError`` for none."""

    def capacity(self) -> int:
        """How many received bytes the kernel can hold now."""

    def room(self) -> int:
        """How many bytes may be handed over now, so that the kernel does not hold what gets stale there."""

    def close(self, *, abort: bool) -> None:
        """Close it; ``abort`` forgets what the kernel has not sent."""


class OutgoingFrames:
    """The frames that wait for one connection, and the rest of the one that is half written."""

    def __init__(self, max_age_s: float, dropped: Counter[str], capacity_bytes: int = OUTGOING_BYTES) -> None:
        self._max_age_s = max_age_s
        self._dropped = dropped
        self._capacity_bytes = capacity_bytes
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._waiting_bytes = 0
        self._begun = b""  # what is left of a frame whose start has been written

    def __len__(self) -> int:
        """How many frames are not wholly written."""
        return len(self._waiting) + bool(self._begun)

    def add(self, frames: Sequence[bytes], now: float) -> None:
        """Have frames wait. Where there is too little room the oldest are dropped, as ``outgoing_full``."""
        self.drop_stale(now)
        for frame in frames:
            self._waiting.append((now, frame))
            self._waiting_bytes += len(frame)
        while self._waiting_bytes > self._capacity_bytes:
            self._take_oldest()
            self._dropped["outgoing_full"] += 1

    def drop_stale(self, now: float) -> None:
        """Drop what waited too long, counted as ``stale``. A frame that is half written has no age."""
        while self._waiting and now - self._waiting[0][0] > self._max_age_s:
            self._take_oldest()
            self._dropped["stale"] += 1

    def next_bytes(self, room: int, now: float) -> bytes:
        """What to write next: whole frames, as many as begin within ``room`` bytes. Changes only what is stale."""
        self.drop_stale(now)
        if room <= 0:
            return b""
        parts = [self._begun] if self._begun else []
        size = len(self._begun)
        for _, frame in self._waiting:
            if size >= room:
                break
            parts.append(frame)
            size += len(frame)
        return b"".join(parts)

    def mark_written(self, count: int) -> int:
        """Take out the first ``count`` of the next bytes. Returns how many frames are now complete."""
        if count < len(self._begun):
            self._begun = self._begun[count:]
            return 0
        completed = 1 if self._begun else 0
        count -= len(self._begun)
        self._begun = b""
        while count:
            frame = self._take_oldest()
            if count < len(frame):
                self._begun = frame[count:]
                break
            count -= len(frame)
            completed += 1
        return completed

    def drop_all(self) -> None:
        """The connection is gone: count what waits for it as ``unsent``."""
        if self:
            self._dropped["unsent"] += len(self)
        self._waiting.clear()
        self._waiting_bytes = 0
        self._begun = b""

    def _take_oldest(self) -> bytes:
        _, frame = self._waiting.popleft()
        self._waiting_bytes -= len(frame)
        return frame


class Connection:
    """One open byte stream and the program at its other end."""

    def __init__(
        self, endpoint: StreamEndpoint, channel: Channel, name: str, opened_at: float, opened_in: int
    ) -> None:
        self.port = LocalPort(endpoint, name, None)
        self.channel = channel
        self.opened_at = opened_at
        self.outgoing = OutgoingFrames(endpoint.max_age_s, endpoint.failures)
        self.lost = asyncio.Event()
        """Set when the port has been reported as closed."""
        self._endpoint = endpoint
        self._splitter = StreamSplitter(endpoint.counters, endpoint.max_gap_s, endpoint.max_hold_s)
        self._loop = asyncio.get_running_loop()
        self._fd = channel.fileno()
        self._stall = endpoint.handler.stall
        self._backlog = Backlog(self._stall, self._fd, channel.capacity, opened_in)
        self._epoch = opened_in  # of the last read
        self._is_open = True
        self._lost_by = ""
        self._has_read = False
        self._awaits_writable = False
        self._room_timer: asyncio.TimerHandle | None = None
        self._blocked_since: float | None = None
        self._loop.add_reader(self._fd, lambda: self.on_readable(monotonic()))

    @property
    def silent_since(self) -> float:
        """When it last sent a genuine frame; when it was opened, if it never did."""
        return self.opened_at if self.port.heard_at is None else self.port.heard_at

    @property
    def ended_well(self) -> bool:
        """Whether the other side ended it, and may still read what the kernel holds."""
        return self._lost_by == DISCONNECTED

    def on_readable(self, now: float) -> None:
        """Read what is there, and hand over its frames at once."""
        epoch = self._backlog.begin(now)
        is_empty = False
        chunks: list[bytes] = []
        left = READ_BYTES
        ended: str | None = None
        while left > 0 and ended is None:
            try:
                chunk = self.channel.read(left)
            except BlockingIOError:
                is_empty = True
                break
            except OSError as error:
                ended = failure_name(error)
            else:
                chunks.append(chunk)
                left -= len(chunk)
                ended = None if chunk else DISCONNECTED
        data = b"".join(chunks)
        self._backlog.end(len(data), is_empty=is_empty)
        if data and not self._has_read:
            self._has_read = True
            if (reason := self._endpoint.objection(data)) is not None:
                self.lose(reason)
                return
        self._endpoint.bytes_received += len(data)
        self._age(epoch)
        # Stale bytes are split too: a stream that is cut amid a frame begins with any bytes of that.
        is_fresh = self._splitter.is_fresh
        frames = self._splitter.feed(data, now)
        if ended is not None:
            frames += self._splitter.end()
        if frames:
            self.port.heard_at = now
            self._endpoint.handler.on_frames(self.port, frames, now, epoch if is_fresh else STALE)
        if ended is not None:
            self.lose(ended)

    def write(self, frames: Sequence[bytes], now: float) -> None:
        """Send frames, or have them wait for those that wait already."""
        if not self._is_open:
            self._endpoint.failures["unsent"] += len(frames)
            return
        self.outgoing.add(frames, now)
        if not self._awaits_writable and self._room_timer is None:
            self._flush(now)

    def on_writable(self, now: float) -> None:
        """The kernel has room again."""
        self._blocked_since = None
        self._awaits_writable = False
        self._loop.remove_writer(self._fd)
        self._flush(now)

    def check(self, now: float) -> None:
        """Drop what got stale; close the connection if nothing of it has moved for long."""
        self._age(self._stall.epoch)
        epoch = self._epoch if self._splitter.is_fresh else STALE
        if frames := self._splitter.give_up(now):
            self._endpoint.handler.on_frames(self.port, frames, now, epoch)
        self.outgoing.drop_stale(now)
        if self._blocked_since is not None and now - self._blocked_since >= STALLED_S:
            self.lose("stalled")

    def _age(self, epoch: int) -> None:
        """What is held of a frame came before a pause: then the frame is not new."""
        if epoch != self._epoch:
            self._epoch = epoch
            self._splitter.age()

    def lose(self, reason: str) -> None:
        """Stop, count why, and report the port as closed soon: never from within ``write``."""
        if self._is_open:
            self._endpoint.failures[reason] += 1
            self._lost_by = reason
            self.stop()
            self._loop.call_soon(self._endpoint.forget, self)

    def stop(self) -> None:
        """Watch it no more. What waits is dropped."""
        self._is_open = False
        self._loop.remove_reader(self._fd)
        if self._awaits_writable:
            self._loop.remove_writer(self._fd)
        if self._room_timer is not None:
            self._room_timer.cancel()
        self.outgoing.drop_all()

    def _flush(self, now: float) -> None:
        """Write what waits until the kernel takes no more."""
        endpoint = self._endpoint
        try:
            while data := self.outgoing.next_bytes(self.channel.room(), now):
                count = self.channel.write(data)
                endpoint.bytes_sent += count
                endpoint.frames_sent += self.outgoing.mark_written(count)
                self._blocked_since = None
                if count < len(data):
                    self._await_writable(now)
                    return
        except BlockingIOError:
            self._await_writable(now)
        except OSError as error:
            self.lose(failure_name(error))
        else:
            if self.outgoing:
                self._await_room(now)

    def _await_writable(self, now: float) -> None:
        self._blocked_since = self._blocked_since if self._blocked_since is not None else now
        self._awaits_writable = True
        self._loop.add_writer(self._fd, lambda: self.on_writable(monotonic()))

    def _await_room(self, now: float) -> None:
        self._blocked_since = self._blocked_since if self._blocked_since is not None else now
        self._room_timer = self._loop.call_later(ROOM_POLL_S, self._on_room_timer)

    def _on_room_timer(self) -> None:
        # Goes on while there is no room even if all that waited got stale, so that a stall is known as one.
        now = monotonic()
        self._room_timer = None
        try:
            room = self.channel.room()
        except OSError as error:
            self.lose(failure_name(error))
            return
        if room <= 0:
            self._await_room(now)
        else:
            self._blocked_since = None
            self._flush(now)


class StreamEndpoint(ABC):
    """An endpoint whose programs are at the other end of byte streams.

    Every frame given to ``write`` is in ``frames_sent``, or waits, or is in ``failures``: as ``outgoing_full``,
    ``stale``, or ``unsent`` where its connection ended. Connections that ended are counted there as ``disconnected``
    by the other side, ``stalled``, or under the kernel's error.
    """

    max_gap_s = MAX_GAP_S
    """A silence inside a frame, after which it is taken for broken."""
    max_hold_s = inf
    """How long all of a frame may take: on a serial line as long as it does."""

    def __init__(self, name: str, handler: PortHandler, max_age_s: float) -> None:
        self.name = name
        self.handler = handler
        self.max_age_s = max_age_s
        self.counters = SplitCounters()
        """What was found in the bytes of all connections."""
        self.failures: Counter[str] = Counter()
        self.bytes_received = 0
        self.bytes_sent = 0
        self.frames_sent = 0
        self._connections: dict[LocalPort, Connection] = {}
        self._told: set[str] = set()  # why it could not be opened, since it last was for long

    @property
    def ports(self) -> Sequence[LocalPort]:
        """Who is connected now."""
        return list(self._connections)

    @abstractmethod
    def start(self) -> None:
        """Begin to listen or to connect, in the running event loop."""

    def gather(self, seconds: float) -> None:  # noqa: B027
        """Nothing: a stream's bytes gather in the kernel, and in its splitter, as they are."""

    def write(self, port: LocalPort, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Send frames to one program, now or when it has room. Returns at once; reports nothing."""
        connection = self._connections.get(port)
        if connection is None:
            self.failures["unsent"] += len(frames)
        else:
            admitted = (port.delivered.admit(frame, source, now) for frame in frames)
            connection.write([data for data in admitted if data], now)

    def do_housekeeping(self, now: float) -> None:
        """Close what has stalled."""
        for connection in list(self._connections.values()):
            connection.check(now)

    def close(self) -> None:
        """Stop and close everything. Reports no port as closed any more."""
        connections = list(self._connections.values())
        self._connections.clear()
        for connection in connections:
            connection.stop()
            connection.channel.close(abort=False)

    def objection(self, first_bytes: bytes) -> str | None:
        """Why a connection that begins with these bytes is to be closed at once; None to keep it."""
        return None

    def open(self, channel: Channel, name: str, now: float, opened_in: int) -> Connection:
        """Take a connection over, and report its port. ``opened_in``: the epoch in which opening it began."""
        connection = Connection(self, channel, name, now, opened_in)
        self._connections[connection.port] = connection
        self.handler.on_port_opened(connection.port)
        return connection

    def could_not_open(self, reason: str) -> None:
        """Count an attempt that failed. Each reason is logged once, until the endpoint has been open for long."""
        self.failures[reason] += 1
        if reason not in self._told:
            self._told.add(reason)
            meaning = _MEANINGS.get(reason, "it is tried again, for ever")
            structlog.get_logger().warning("endpoint_not_open", endpoint=self.name, reason=reason, meaning=meaning)

    def forget(self, connection: Connection) -> None:
        """Report the port of a lost connection as closed, once."""
        if self._connections.pop(connection.port, None) is not None:
            if monotonic() - connection.opened_at >= LASTED_S:
                self._told.clear()
            self.handler.on_port_closed(connection.port)
            self.dispose(connection)
            connection.lost.set()

    def dispose(self, connection: Connection) -> None:
        """Close the channel of a lost connection."""
        connection.channel.close(abort=not connection.ended_well)
