"""The common part of TCP and serial endpoints: frames in byte streams, and a bounded wait for slow clients.

Frames that the kernel does not accept at once wait in a queue of their connection (:mod:`.outgoing`): a fair share of
bytes for each source, urgent frames first, only the newest state. The kernel holds few bytes, because frames there
can be neither dropped nor overtaken.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from math import inf
from typing import Protocol

import structlog

from uavlinkd.io.outgoing import OutgoingFrames
from uavlinkd.io.ports import Endpoint, LocalPort, PortHandler, failure_name
from uavlinkd.mavlink.frames import MAX_GAP_S, Frame, StreamSplitter
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.system.clock import monotonic
from uavlinkd.system.error_meanings import NAME_NOT_RESOLVED, meaning_of
from uavlinkd.system.guard import run
from uavlinkd.system.stall import STALE, Backlog

READ_BYTES = 4096  # from one connection in a wake-up; the costliest bytes take some 10 ms
STALLED_S = 30.0  # a connection that accepted no byte for this long is closed, with its queue
LASTED_S = 60.0  # after an endpoint was open for this long, its next failure is logged again

DISCONNECTED = "disconnected"

_MEANINGS = {
    "EPERM": "this service may not open the device: see DeviceAllow in its unit",
    "connect_timeout": "there is no answer from there now",
    "not_resolved": meaning_of(NAME_NOT_RESOLVED),
}  # where the common table does not say it


class ByteChannel(Protocol):
    """The kernel's side of one connection. No method blocks."""

    def fileno(self) -> int: ...

    def read(self, size: int) -> bytes:
        """The received bytes, up to ``size``; no bytes at the end of the stream.

        Raises BlockingIOError if no bytes are there.
        """

    def write(self, data: bytes) -> int:
        """Pass bytes to the kernel. Returns how many it accepted.

        Raises BlockingIOError if it accepts no bytes now.
        """

    def capacity(self) -> int:
        """How many received bytes the kernel can hold now."""

    @property
    def limit_bytes(self) -> int:
        """The kernel gets no more than this, except for a single larger frame while it holds no bytes."""

    def held(self, now: float) -> int:
        """How many of the kernel's bytes count towards the limit."""

    def drain_s(self, to_bytes: int, now: float) -> float:
        """After how many seconds the kernel should hold no more than ``to_bytes``."""

    def close(self, *, abort: bool) -> None:
        """Close it; ``abort`` discards the kernel's unsent bytes, and resets a TCP connection."""


class Connection(LocalPort):
    """One open byte stream and the client at its other end."""

    endpoint: StreamEndpoint

    def __init__(
        self, endpoint: StreamEndpoint, channel: ByteChannel, name: str, opened_at: float, opened_in: int
    ) -> None:
        super().__init__(endpoint, name, None)
        self.channel = channel
        self.opened_at = opened_at
        self.outgoing = OutgoingFrames(endpoint.failures, self.delivered, self.signed)
        self.lost = asyncio.Event()  # set when the port has been reported as closed
        self._splitter = StreamSplitter(endpoint.counters, endpoint.max_gap_s, endpoint.max_hold_s)
        self._loop = asyncio.get_running_loop()
        self._fd = channel.fileno()
        self._stall = endpoint.handler.stall
        self._backlog = Backlog(self._stall, self._fd, channel.capacity, opened_in)
        self._is_open = True
        self.ended_well = False  # whether the client ended it, and may still read the kernel's bytes
        self._has_read = False
        self._awaits_writable = False
        self._room_timer: asyncio.TimerHandle | None = None
        self._blocked_since: float | None = None
        self._loop.add_reader(self._fd, lambda: self.on_readable(monotonic()))

    @property
    def silent_since(self) -> float:
        """When it last sent a genuine frame; if it never did, when it was opened."""
        return self.opened_at if self.received_at is None else self.received_at

    def on_readable(self, now: float) -> None:
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
            if data.startswith(self.endpoint.refused_starts):
                self.lose("http")
                return
        self.endpoint.bytes_received += len(data)
        # Stale bytes are split too: otherwise the stream would go on in the middle of a frame.
        frames = self._splitter.feed(data, now, epoch)
        if ended is not None:
            frames += self._splitter.end()
        if frames:
            self.received_at = now
            self.endpoint.on_frames(self, frames, now, epoch if self._splitter.is_fresh else STALE)
        if ended is not None:
            self.lose(ended)

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float = 0.0) -> None:
        """Write frames, or queue them behind those that wait already."""
        if not self._is_open:
            self.endpoint.failures["unsent"] += len(frames)
        elif self._awaits_writable or self._room_timer is not None:
            self.outgoing.queue.put(frames, source, now)
        else:
            self._write_at_once(frames, source, now)

    def on_writable(self, now: float) -> None:
        """Write more: the kernel has room again."""
        self._blocked_since = None
        self._awaits_writable = False
        self._loop.remove_writer(self._fd)
        self._flush(now)

    def check(self, now: float) -> None:
        """Drop stale frames. Close the connection if the kernel has accepted no byte for long."""
        if frames := self._splitter.give_up(now, self._stall.epoch):
            epoch = self._stall.epoch if self._splitter.is_fresh else STALE
            self.endpoint.on_frames(self, frames, now, epoch)
        self.outgoing.queue.drop_stale(now)
        if self.outgoing.queue.count and not self._awaits_writable and self._room_timer is None:
            self._flush(now)  # a fault has interrupted the last one
        if self._blocked_since is not None and now - self._blocked_since >= STALLED_S:
            self.lose("stalled")

    def lose(self, reason: str) -> None:
        """Stop, count the reason, and report the port as closed in the loop's next turn, never in :meth:`send`."""
        if self._is_open:
            self.endpoint.failures[reason] += 1
            self.ended_well = reason == DISCONNECTED
            self.stop()
            self._loop.call_soon(self.endpoint.forget, self)

    def stop(self) -> None:
        """Stop watching the channel, and drop the frames that wait."""
        self._is_open = False
        self._loop.remove_reader(self._fd)
        self._backlog.close()
        if self._awaits_writable:
            self._loop.remove_writer(self._fd)
        if self._room_timer is not None:
            self._room_timer.cancel()
        self.outgoing.drop_all()

    def _write_at_once(self, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Write while the kernel has room, and queue the other frames. Call it only while no frame waits."""
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
            self.outgoing.queue.put(frames[count:], source, now)
            self.lose(failure_name(error))
            return
        if count < len(frames):
            self.outgoing.queue.put(frames[count:], source, now)
            if not self._awaits_writable:
                self._flush(now)

    def _count_fitting(self, frames: Sequence[Frame], first: int, now: float) -> int:
        """The end of the frames from ``first`` on that fit. One always fits while the kernel holds no bytes."""
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
        """Write waiting frames until the kernel has no more room."""
        channel = self.channel
        outgoing = self.outgoing
        try:
            while True:
                outgoing.commit_next(channel.held(now), channel.limit_bytes, now)
                if not outgoing.committed:
                    break
                if not self._write_committed(now):
                    return
            if outgoing.queue.count:
                self._await_room(now)
        except OSError as error:
            self.lose(failure_name(error))

    def _write_committed(self, now: float) -> bool:
        """Pass committed bytes to the kernel. Returns whether it accepted all; if not, wait until it accepts more.

        Raises OSError if the connection has ended.
        """
        data = self.outgoing.committed
        try:
            count = self.channel.write(data)
        except BlockingIOError:
            self._await_writable(now)
            return False
        self.endpoint.bytes_sent += count
        self.endpoint.frames_sent += self.outgoing.mark_written(count)
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
        """Look again when the next frame should fit. The kernel sends no event for room that was never used up.

        Raises OSError if the connection has ended.
        """
        self._blocked_since = self._blocked_since if self._blocked_since is not None else now
        size = self.outgoing.queue.next_bytes(now)
        to_bytes = max(0, self.channel.limit_bytes - size) if size else 0
        self._room_timer = self._loop.call_later(self.channel.drain_s(to_bytes, now), self._on_room_timer)

    def _on_room_timer(self) -> None:
        # Go on while the kernel holds bytes, even if no frame waits any more, so that a stall is detected.
        now = monotonic()
        self._room_timer = None
        try:
            if self.channel.held(now) == 0:
                self._blocked_since = None
            elif not self.outgoing.queue.count:
                self._await_room(now)
                return
        except OSError as error:
            self.lose(failure_name(error))
            return
        self._flush(now)


class StreamEndpoint(Endpoint):
    """An endpoint whose clients are connected by byte streams.

    Every frame passed to a port is counted in ``frames_sent``, or waits, or was refused
    (:mod:`uavlinkd.mavlink.policy.delivery`), or is counted in ``failures``: ``outgoing_full``, ``stale``,
    ``thinned`` (a newer state replaced it), or ``unsent`` (its connection ended). ``failures`` also counts the
    connections that ended: ``disconnected`` (by the client), ``stalled``, or the kernel's error.
    """

    max_gap_s = MAX_GAP_S  # a frame with a longer gap inside counts as broken
    max_hold_s = inf  # How long a frame may take as a whole. Serial lines have no limit.
    refused_starts: tuple[bytes, ...] = ()
    """A connection that begins with one of these comes from a browser and is closed."""

    def __init__(self, name: str, handler: PortHandler) -> None:
        super().__init__(name, handler)
        self._connections: list[Connection] = []
        self._logged: set[str] = set()  # reasons of failures to open it, since it was last open for long

    @property
    def ports(self) -> Sequence[Connection]:
        return list(self._connections)

    def do_housekeeping(self, now: float) -> None:
        for connection in self.ports:
            run(connection.check, now)

    def close(self) -> None:
        super().close()
        connections, self._connections = self._connections, []
        for connection in connections:
            connection.stop()
            connection.channel.close(abort=False)

    def open(self, channel: ByteChannel, name: str, now: float, opened_in: int) -> Connection:
        """Add a connection and report its port. ``opened_in`` is the epoch in which opening it began."""
        connection = Connection(self, channel, name, now, opened_in)
        try:
            self.handler.on_port_opened(connection)
        except Exception:
            connection.stop()
            self.dispose(connection)
            raise
        self._connections.append(connection)
        return connection

    def could_not_open(self, reason: str) -> None:
        """Count an attempt that failed. Each reason is logged once, until the endpoint has been open for long."""
        self.failures[reason] += 1
        if reason not in self._logged:
            self._logged.add(reason)
            meaning = _MEANINGS.get(reason) or meaning_of(reason) or "it is tried again indefinitely"
            structlog.get_logger().warning("endpoint_not_open", endpoint=self.name, reason=reason, meaning=meaning)

    def forget(self, connection: Connection) -> None:
        """Report the port of a lost connection as closed, once."""
        if connection in self._connections:
            self._connections.remove(connection)
            if monotonic() - connection.opened_at >= LASTED_S:
                self._logged.clear()
            run(self.handler.on_port_closed, connection)
            self.dispose(connection)
            connection.lost.set()

    def dispose(self, connection: Connection) -> None:
        connection.channel.close(abort=not connection.ended_well)
