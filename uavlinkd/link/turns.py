"""Datagrams that wait because the daemon is busy. Senders take turns, so one that sends too much delays only itself.

While there is time for everything, nothing waits here: the daemon handles datagrams as they arrive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator

from uavlinkd.core.outputs import Path

TURN_S = 0.003
"""How much of the processor's time one sender's turn takes at most, without the delivery of its frames. Another
sender's frames then wait for some such turns, which is far below a radio's delay. Not time by the clock: where other
programs have the processor meanwhile, each turn would end after one datagram."""
TURN_FRAMES = 300
"""Frames that end a turn too, by :func:`cost_of`: to deliver one costs as much as to read it."""
STARTS_OF_A_FRAME = 4
"""So many start bytes in payloads cost as much as a frame: each may begin a hidden one (:mod:`.mavlink.hidden`)."""
WAITING_BYTES = 65536
"""Of one sender's datagrams: the largest one fits, and a burst of fifty of the default size."""
WAITING_OVERHEAD_BYTES = 64
"""Counted with each of them, so that many small ones, and empty ones, are bounded too."""

Waiting = tuple[bytes, Path]
"""A datagram, and the path that it came along."""


class Turns:
    """A queue for each sender, first in, first out. True while something waits.

    Bounded: senders are those that :meth:`uavlinkd.core.node.Node.sender_of` tells apart.
    """

    def __init__(self) -> None:
        self._queues: dict[Hashable, deque[tuple[Waiting, int]]] = {}
        self._bytes: dict[Hashable, int] = {}

    def __bool__(self) -> bool:
        return bool(self._queues)

    def put(self, sender: Hashable, datagram: bytes, path: Path, epoch: int) -> list[Waiting]:
        """Have a datagram wait. Returns what it pushes out, the oldest first: newer frames supersede older ones.

        ``epoch``: that of its reading, as :class:`uavlinkd.system.stall.StallWatch` counts them.
        """
        queue = self._queues.setdefault(sender, deque())
        size = self._bytes.get(sender, 0) + _size(datagram)
        queue.append(((datagram, path), epoch))
        pushed_out: list[Waiting] = []
        while size > WAITING_BYTES and len(queue) > 1:
            pushed_out.append(queue.popleft()[0])
            size -= _size(pushed_out[-1][0])
        self._bytes[sender] = size
        return pushed_out

    def round(self) -> Iterator[tuple[Iterator[Waiting], int]]:
        """The datagrams of each sender that waits now, one turn of one epoch for each. The rest goes on waiting."""
        for sender, queue in list(self._queues.items()):
            epoch = queue[0][1]
            yield self._turn(sender, epoch), epoch
            if not self._queues[sender]:
                del self._queues[sender], self._bytes[sender]

    def _turn(self, sender: Hashable, epoch: int) -> Iterator[Waiting]:
        queue = self._queues[sender]
        while queue and queue[0][1] == epoch:
            waiting, _ = queue.popleft()
            self._bytes[sender] -= _size(waiting[0])
            yield waiting


def cost_of(payload: bytes, frames: int) -> int:
    """What it costs to deliver a payload of so many frames, in frames of the usual kind."""
    starts = payload.count(b"\xfd") + payload.count(b"\xfe")
    return frames + max(0, starts - frames) // STARTS_OF_A_FRAME


def _size(datagram: bytes) -> int:
    return len(datagram) + WAITING_OVERHEAD_BYTES
