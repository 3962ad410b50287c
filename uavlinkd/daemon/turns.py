"""The datagrams that wait while the daemon is busy: a queue for each sender, and what a turn of one may cost."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator
from typing import Final

from uavlinkd.daemon.features import WaitingDatagram
from uavlinkd.protocol.path import Path

STARTS_OF_A_FRAME: Final = 4
"""So many start bytes in payloads cost as much as a frame: each may begin a hidden one
(:mod:`uavlinkd.mavlink.policy.hidden`)."""
WAITING_BYTES: Final = 65536
"""Of one sender's datagrams, at least: the largest one fits, and a burst of fifty of the default size."""
SHARED_BYTES: Final = 4 * WAITING_BYTES
"""Divided among the senders that wait, if that is more. Without rivals, a fast log download survives 0.3 s in which
this process does not run. A longer queue would delay the frames of a sender that always sends too much."""
WAITING_OVERHEAD_BYTES: Final = 64
"""Counted with each datagram, so that many small or empty ones are bounded too."""


class Turns:
    """A queue for each sender, first in, first out.

    Bounded: senders are those that :meth:`uavlinkd.protocol.node.Node.claimed_sender` tells apart.
    """

    def __init__(self) -> None:
        self.queues: dict[Hashable, deque[tuple[WaitingDatagram, int]]] = {}
        """By sender: datagrams that wait, with the epoch of their reading. No queue here is empty."""
        self._bytes: dict[Hashable, int] = {}

    def put(self, sender: Hashable, datagram: bytes, path: Path, epoch: int) -> list[WaitingDatagram]:
        """Let a datagram wait. Returns the datagrams that it pushes out, the oldest first: newer frames supersede
        older ones.

        ``epoch``: that of its reading, as :class:`uavlinkd.system.stall.StallWatch` counts them.
        """
        queue = self.queues.setdefault(sender, deque())
        size = self._bytes.get(sender, 0) + _size(datagram)
        queue.append(((datagram, path), epoch))
        pushed_out: list[WaitingDatagram] = []
        share = max(WAITING_BYTES, SHARED_BYTES // len(self.queues))
        while size > share and len(queue) > 1:
            pushed_out.append(queue.popleft()[0])
            size -= _size(pushed_out[-1][0])
        self._bytes[sender] = size
        return pushed_out

    def round(self) -> Iterator[tuple[Iterator[WaitingDatagram], int]]:
        """One turn of each sender that has datagrams waiting, all of one epoch. The rest waits for the next round."""
        for sender, queue in list(self.queues.items()):
            epoch = queue[0][1]
            yield self._turn(sender, queue, epoch), epoch

    def _turn(
        self, sender: Hashable, queue: deque[tuple[WaitingDatagram, int]], epoch: int
    ) -> Iterator[WaitingDatagram]:
        while queue and queue[0][1] == epoch:
            waiting, _ = queue.popleft()
            self._bytes[sender] -= _size(waiting[0])
            if not queue:  # before anything can fail
                del self.queues[sender], self._bytes[sender]
            yield waiting


def cost_of(payload: bytes, frames: int) -> int:
    """The cost to deliver a payload of so many frames, in frames of the usual kind."""
    starts = payload.count(b"\xfd") + payload.count(b"\xfe")
    return frames + max(0, starts - frames) // STARTS_OF_A_FRAME


def _size(datagram: bytes) -> int:
    return len(datagram) + WAITING_OVERHEAD_BYTES
