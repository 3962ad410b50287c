"""What TCP and serial ports share: frames into and out of byte streams, and a bounded wait for a slow other side.

What the kernel does not take at once waits in its connection's own queue (:mod:`.outgoing`): urgent frames first,
each source its fair share, the newest state. The kernel holds little, because frames there can be neither dropped
nor overtaken.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from math import inf
from typing import Protocol

import structlog

from uavlinkd.system.clock import monotonic
from uavlinkd.endpoints.outgoing import OutgoingFrames
from uavlinkd.endpoints.ports import LocalPort, PortHandler, failure_name
from uavlinkd.mavlink.policy.delivery import DeliveredStreams, Source
from uavlinkd.mavlink.frames import MAX_GAP_S, Frame, SplitCounters, StreamSplitter
from uavlinkd.system.stall import STALE, Backlog

MAX_AGE_S = 1.0
"""A frame that waited longer than this for its turn is not sent any more."""
READ_BYTES = 4096
"""Read of one connection in a wake-up; then the others have their turn. The costliest bytes take some 10 ms."""
STALLED_S = 30.0
"""A connection that took no byte for this long is closed, so that what nobody reads is not held for ever."""
LASTED_S = 60.0
"""An endpoint that was open for so long and then is not is news; one that comes and goes fills no log."""

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

    @property
    def limit_bytes(self) -> int:
        """The kernel is handed no more than this, except for a single larger frame while it holds nothing."""

    def held(self, now: float) -> int:
        """How many bytes the kernel holds that count towards the limit."""

    def drain_s(self, to_bytes: int, now: float) -> float:
        """In how many seconds the kernel should hold no more than ``to_bytes``."""

    def close(self, *, abort: bool) -> None:
        """Close it; ``abort`` forgets what the kernel has not sent."""


class Connection:
    """One open byte stream and the program at its other end."""

    def __init__(
        self, endpoint: StreamEndpoint, channel: Channel, name: str, opened_at: float, opened_in: int
    ) -> None:
        self.port = LocalPort(endpoint, name, None, endpoint.delivered.of(name))
        self.channel = channel
        self.opened_at = opened_at
        self.outgoing = OutgoingFrames(endpoint.max_age_s, endpoint.failures, self.port.delivered)
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

    def write(self, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Send frames, or have them wait for those that wait already."""
        if not self._is_open:
            self._endpoint.failures["unsent"] += len(frames)
        elif self._awaits_writable or self._room_timer is not None:
            self.outgoing.put(frames, source, now)
        else:
            self._write_at_once(frames, source, now)

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

    def _write_at_once(self, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Write what the kernel has room for, while no other frame waits. The rest waits for its turn."""
        count = 0
        try:
            while count < len(frames) and not self._awaits_writable:
                fitting = self._count_fitting(frames, count, now)
                if fitting == count:
                    break
                self.outgoing.commit(frames[count:fitting], source, now)
                count = fitting
                self._write_committed(now)
        except OSError as error:
            self.outgoing.put(frames[count:], source, now)
            self.lose(failure_name(error))
            return
        if count < len(frames):
            self.outgoing.put(frames[count:], source, now)
            if not self._awaits_writable:
                self._flush(now)

    def _count_fitting(self, frames: Sequence[Frame], first: int, now: float) -> int:
        """How far the frames from ``first`` on fit into the kernel's room. One always fits where it holds nothing."""
        held = self.channel.held(now)
        limit = self.channel.limit_bytes
        count = first
        for frame in frames[first:]:
            size = len(frame.raw)
            if held and held + size > limit:
                break
            held += size
            count += 1
        return count

    def _flush(self, now: float) -> None:
        """Write what waits until the kernel has no room for more."""
        channel = self.channel
        outgoing = self.outgoing
        try:
            while True:
                outgoing.commit_next(channel.held(now), channel.limit_bytes, now)
                if not outgoing.committed:
                    break
                if not self._write_committed(now):
                    return
            if outgoing.waiting:
                self._await_room(now)
        except OSError as error:
            self.lose(failure_name(error))

    def _write_committed(self, now: float) -> bool:
        """Hand committed bytes to the kernel. Returns whether it took them all; else wait until it takes more.

        Raises:
            OSError: the connection is gone.
        """
        data = self.outgoing.committed
        try:
            count = self.channel.write(data)
        except BlockingIOError:
            self._await_writable(now)
            return False
        self._endpoint.bytes_sent += count
        self._endpoint.frames_sent += self.outgoing.mark_written(count)
        self._blocked_since = None
        if count < len(data):
            self._await_writable(now)
            return False
        return True

    def _await_writable(self, now: float) -> None:
        self._blocked_since = self._blocked_since if self._blocked_since is not None else now
        self._awaits_writable = True
        self._loop.add_writer(self._fd, lambda: self.on_writable(monotonic()))

    def _await_room(self, now: float) -> None:
        """Look again when the next frame should fit. The kernel sends no event while this side leaves it empty.

        Raises:
            OSError: the connection is gone.
        """
        self._blocked_since = self._blocked_since if self._blocked_since is not None else now
        size = self.outgoing.next_bytes(now)
        to_bytes = max(0, self.channel.limit_bytes - size) if size else 0
        self._room_timer = self._loop.call_later(self.channel.drain_s(to_bytes, now), self._on_room_timer)

    def _on_room_timer(self) -> None:
        # Goes on while the kernel holds bytes even if all that waited got stale, so that a stall is known as one.
        now = monotonic()
        self._room_timer = None
        try:
            if self.channel.held(now) == 0:
                self._blocked_since = None
            elif not self.outgoing.waiting:
                self._await_room(now)
                return
        except OSError as error:
            self.lose(failure_name(error))
            return
        self._flush(now)


class StreamEndpoint(ABC):
    """An endpoint whose programs are at the other end of byte streams.

    Every frame given to ``write`` is in ``frames_sent``, or waits, or was refused (:mod:`uavlinkd.mavlink.policy.delivery`),
    or is in ``failures``: as ``outgoing_full``, ``stale``, ``thinned`` (a newer state replaced it), or ``unsent``
    where its connection ended. Connections that ended are counted there as ``disconnected`` by the other side,
    ``stalled``, or under the kernel's error.
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
        self.delivered = DeliveredStreams()
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
        """Send frames to one client, now or when it has room. Returns at once; reports nothing."""
        connection = self._connections.get(port)
        if connection is None:
            self.failures["unsent"] += len(frames)
        else:
            connection.write(frames, source, now)

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
