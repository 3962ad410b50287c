"""Reads datagrams from a socket, in batches when it is busy."""

from __future__ import annotations

import asyncio
import socket
from array import array
from collections.abc import Callable
from math import inf
from typing import Any

from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import run
from uavlinkd.system.stall import STALE, STALL_S, Backlog, StallWatch

try:
    import fcntl
    import termios
except ImportError:  # Windows
    _CAN_ASK = False
else:
    _CAN_ASK = True

DATAGRAMS_PER_WAKE_UP = 128
RECEIVE_BYTES = 65536
_buffer = memoryview(bytearray(RECEIVE_BYTES))
"""Every datagram is read into this buffer and copied at its own size. A new buffer of 64 KiB for each of them would
leave holes between objects that live long, and the heap would grow for hours."""
BUSY_S = 0.0005  # a socket that is readable again so soon after its last batch is busy: about 2,000 datagrams/s
PAUSE_S = 0.001
"""How long datagrams gather in a busy socket. A radio's delay is many times that. At 10,000 datagrams/s the process
has a third less to do than with a quarter of it."""
DATAGRAM_OVERHEAD_BYTES = 256
"""A datagram takes at least this much of a receive buffer in addition to its length: the kernel's own record of it
(struct sk_buff). Linux 6.18 on x86-64 takes 830."""

Datagrams = list[tuple[bytes, tuple[Any, ...]]]  # datagrams, each with the socket address of its sender


DatagramHandler = Callable[[Datagrams, float, int, float], None]
"""Receives the datagrams of one read. The numbers: the monotonic time and the epoch of the read
(:mod:`uavlinkd.system.stall`), and for how many seconds the first datagram may have waited in the socket."""


class Reader:
    """Reads a socket in the running loop and delivers its datagrams in batches.

    A wake-up costs more than a datagram. So the reader adapts to the traffic, as drivers of network cards do:

    * A quiet socket is read when it becomes readable: one datagram.
    * If it is readable again within :data:`BUSY_S`, the rest of a burst is there: all datagrams are read.
    * If it is readable within :data:`BUSY_S` once more, it is busy. The loop stops to watch it, and a timer reads it
      every :data:`PAUSE_S` until a read finds fewer than two datagrams.

    ``on_failure`` receives each error that a read returns, such as the failure of an earlier send. With a ``pause_s``
    of 0 a busy socket is read at once too: a relay must not delay what it forwards. ``most``: of one read; then the
    other sockets have their turn.
    """

    __slots__ = (
        *("_burst_until", "_busy_until", "_calm_in", "_deliver", "_is_watched", "_loop", "_most", "_on_failure"),
        *("_pause_s", "_sock", "_stall", "_timer", "_waiting", "backlog", "gather_s"),
    )

    def __init__(
        self,
        sock: socket.socket,
        deliver: DatagramHandler,
        on_failure: Callable[[OSError], None],
        stall: StallWatch,
        pause_s: float = PAUSE_S,
        most: int = DATAGRAMS_PER_WAKE_UP,
    ) -> None:
        self.backlog = Backlog(stall, sock.fileno(), lambda: sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
        self._sock = sock
        self._deliver = deliver
        self._on_failure = on_failure
        self._pause_s = pause_s
        self._most = most
        self._stall = stall
        self._loop = asyncio.get_running_loop()
        self._is_watched = False  # by the loop
        self._timer: asyncio.TimerHandle | None = None  # reads the socket next, and not the loop
        self.gather_s = 0.0
        """How long after the first datagram the others are read too; 0: at once. :meth:`gather` sets it."""
        self._busy_until = -inf  # a datagram before then comes soon after the last batch
        self._burst_until = inf  # as _busy_until, if the last read was soon after the one before it
        self._calm_in: int | None = stall.epoch
        """The epoch, if a datagram is to be expected alone, and none from before a pause."""
        self._waiting = array("i", [0])

    def start(self) -> None:
        self._is_watched = True
        self._loop.add_reader(self._sock, self._on_readable)

    def stop(self) -> None:
        """Read no more. Call it before the socket is closed."""
        self.backlog.close()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        elif self._is_watched:
            self._unwatch()

    def gather(self, seconds: float) -> None:
        """Read once for all datagrams that arrive within ``seconds``, and not for each of them."""
        self.gather_s, self._calm_in = seconds, None

    def renew(self) -> None:
        """Have the loop watch the socket again: libuv stops watching a socket that has an error pending."""
        if self._is_watched:
            self._unwatch()
            self.start()

    def _on_readable(self) -> None:
        now = monotonic()
        stall = self._stall
        epoch = stall.epoch
        if now < self._busy_until or epoch != self._calm_in or now - stall.turned_at > STALL_S:
            self._on_several(now)
            return
        # At most rates a datagram comes alone. Each call costs, so this case has none of its own.
        stall.turned_at = now
        try:
            size, source = self._sock.recvfrom_into(_buffer)
        except OSError as error:
            self._is_drained(error)
            self.renew()
            return
        self._deliver([(bytes(_buffer[:size]), source)], now, epoch, 0.0)
        self.backlog.read_at = now
        self._busy_until = monotonic() + BUSY_S

    def _on_several(self, now: float) -> None:
        """Several datagrams may be there, or may soon be."""
        if self.gather_s:
            self._pause(self.gather_s)
        elif now >= self._busy_until:
            self.read(now, drains=False)
        elif self._burst_until == self._busy_until and self._pause_s:
            self._pause(self._pause_s)
        else:
            self.read(now)
            self._burst_until = self._busy_until

    def _pause(self, seconds: float) -> None:
        self._unwatch()
        self._timer = self._loop.call_later(seconds, self._on_timer, seconds)

    def _on_timer(self, waited_s: float) -> None:
        count, is_burst = 0, self._burst_until == self._busy_until
        try:
            count = self.read(monotonic(), waited_s)
        finally:
            if is_burst:
                self._burst_until = self._busy_until
            if self._timer is not None:  # the handler of the datagrams did not stop this reader
                self._timer = None
                if count < 2 or self.gather_s:
                    self.start()
                else:
                    seconds = self._pause_s if count < self._most else 0.0
                    self._timer = self._loop.call_later(seconds, self._on_timer, seconds)

    def _unwatch(self) -> None:
        self._is_watched = False
        self._loop.remove_reader(self._sock)

    def read(self, now: float, waited_s: float = 0.0, *, drains: bool = True) -> int:
        """Read up to ``most`` datagrams and deliver them. Returns how many there were.

        Without ``drains``, read a second one only if FIONREAD reports it. Asking is cheaper than reading in vain.
        """
        datagrams: Datagrams = []
        epoch = self.backlog.begin(now)
        if epoch == STALE:
            # Only a read in vain shows that the queue is empty: FIONREAD reports 0 for an empty datagram too.
            is_empty = self._drain(datagrams)
            self.backlog.end(
                sum(len(datagram) + DATAGRAM_OVERHEAD_BYTES for datagram, _ in datagrams), is_empty=is_empty
            )
        elif drains or self._has_more_than_one(datagrams):
            self._drain(datagrams)
        count = len(datagrams)
        is_calm = count < 2 and not self.gather_s and not self.backlog.left
        self._calm_in = self._stall.epoch if is_calm else None
        self._deliver(datagrams, now, epoch, waited_s)
        # Behind a full batch, more datagrams have gathered already. New ones must not wait behind stale ones.
        is_full = epoch == STALE or count == self._most
        self._busy_until = -inf if is_full else monotonic() + BUSY_S
        return count

    def _has_more_than_one(self, datagrams: Datagrams) -> bool:
        """Read the first datagram. Returns whether another may be behind it."""
        try:
            size, source = self._sock.recvfrom_into(_buffer)
        except OSError as error:
            return not self._is_drained(error)
        datagrams.append((bytes(_buffer[:size]), source))
        if not _CAN_ASK:
            return True
        fcntl.ioctl(self._sock, termios.FIONREAD, self._waiting)
        return self._waiting[0] > 0

    def _drain(self, datagrams: Datagrams) -> bool:
        """Read up to a batch. Returns whether the queue is empty now."""
        for _ in range(self._most - len(datagrams)):
            try:
                size, source = self._sock.recvfrom_into(_buffer)
                datagrams.append((bytes(_buffer[:size]), source))
            except OSError as error:
                if self._is_drained(error):
                    return True
        return False

    def _is_drained(self, error: OSError) -> bool:
        """Whether the error means that the queue is empty. Report any other."""
        if isinstance(error, BlockingIOError):
            return True
        run(self._on_failure, error)
        self.renew()
        return False
