"""From the datagrams of the peers to their frames. While the daemon is busy, senders take turns."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from time import thread_time

from uavlinkd.system.clock import monotonic
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output, Path
from uavlinkd.core.wire import ENVELOPE_STARTS
from uavlinkd.mavlink.frames import Frame
from uavlinkd.link.peer_sockets import Arrived
from uavlinkd.system.stall import StallWatch
from uavlinkd.link.turns import TURN_FRAMES, TURN_S, Turns


class Intake:
    """Receives what arrives from the peers, and forwards the frames in it once in each turn.

    ``perform`` gets the core's outputs, and reports frames among them by :meth:`add`. ``forward`` gets the frames of
    one peer, with the time and the epoch of their reading. ``settle`` is called when the core may have new deadlines.
    """

    def __init__(
        self,
        node: Node,
        stall: StallWatch,
        perform: Callable[[list[Output]], None],
        forward: Callable[[str, list[Frame], float, int], None],
        settle: Callable[[], None],
    ) -> None:
        self._node = node
        self._stall = stall
        self._perform = perform
        self._forward = forward
        self._settle = settle
        self._loop = asyncio.get_running_loop()
        self._turns = Turns()
        self._frames: dict[str, list[Frame]] = {}
        self._cost = 0

    def on_arrived(self, arrived: Arrived, now: float, epoch: int) -> None:
        """Receive what came in one wake-up, or have it wait for its senders' turns."""
        if len(arrived) == 1 and not self._turns:  # a turn of one needs no clock
            self._perform(self._node.receive(*arrived[0], now))
            self._deliver(now, epoch)
        else:
            envelopes = self._receive_handshakes(arrived, now)
            if self._turns:
                self._have_wait(envelopes, epoch)
            else:
                arriving = iter(envelopes)
                self._take_turn(arriving, now, epoch)
                if rest := list(arriving):
                    self._have_wait(rest, epoch)
                    self._loop.call_soon(self._take_turns)
        self._settle()

    def _receive_handshakes(self, arrived: Arrived, now: float) -> Arrived:
        """Receive all but envelopes, which are returned.

        Handshake messages have budgets of their own in the core. If they waited for turns, their senders would repeat
        them meanwhile, and a busy daemon would be busier.
        """
        envelopes = []
        for datagram, path in arrived:
            if datagram[:1] in ENVELOPE_STARTS:
                envelopes.append((datagram, path))
            else:
                self._perform(self._node.receive(datagram, path, now))
        return envelopes

    def add(self, peer: str, frames: list[Frame], cost: int) -> None:
        """Frames of a peer came out of the core. They go on when the turn is over; ``cost`` is charged to it."""
        self._cost += cost
        if peer in self._frames:
            self._frames[peer] += frames
        else:
            self._frames[peer] = frames

    def clear(self) -> None:
        """Forget what waits."""
        self._turns = Turns()

    def _have_wait(self, arrived: Arrived, epoch: int) -> None:
        sender_of = self._node.sender_of
        for datagram, path in arrived:
            for pushed_out in self._turns.put(sender_of(datagram, path), datagram, path, epoch):
                self._perform([self._node.refuse(*pushed_out)])

    def _take_turns(self) -> None:
        """Let each sender have one turn; then the sockets, the timer and the control socket have theirs."""
        self._stall.turn(monotonic())
        try:
            for turn, epoch in self._turns.round():
                self._take_turn(turn, monotonic(), epoch)
        finally:
            if self._turns:
                self._loop.call_soon(self._take_turns)
            self._settle()

    def _take_turn(self, arriving: Iterator[tuple[bytes, Path]], now: float, epoch: int) -> None:
        """Receive until there is no more, or the turn is over; deliver the frames."""
        # Stale datagrams are opened too: their counters must be used up, or an attacker could replay them as new.
        receive, self._cost, ends_at = self._node.receive, 0, thread_time() + TURN_S
        for datagram, path in arriving:
            self._perform(receive(datagram, path, now))
            if self._cost >= TURN_FRAMES or thread_time() >= ends_at:
                break
        self._deliver(now, epoch)

    def _deliver(self, now: float, epoch: int) -> None:
        if epoch != self._stall.epoch:
            self._perform(self._node.take_held())  # stale as well, even if the peer calls them new later
        delivered, self._frames = self._frames, {}
        for peer, frames in delivered.items():
            self._forward(peer, frames, now, epoch)
