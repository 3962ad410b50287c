"""From the datagrams of the peers to their frames. While the daemon is busy, senders take turns."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from time import thread_time

from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, LinkedPeer, Output
from uavlinkd.core.path import Path, SocketAddress
from uavlinkd.core.wire import ENVELOPE_STARTS
from uavlinkd.endpoints.reader import Datagrams
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.switch import Switch
from uavlinkd.link.turns import TURN_FRAMES, TURN_S, Turns, WaitingDatagram, cost_of
from uavlinkd.mavlink.frames import Frame, split_payload
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import STALL_S, StallWatch

HANDSHAKES_S = 0.01
"""CPU time for handshake messages before the envelopes have their turn: about twenty of them."""
WAITING_HANDSHAKES = 256
"""Handshake messages that wait, at most: what is handled in a tenth of a second."""
MAX_PATHS = 1024
"""Paths of received datagrams that are remembered: a frame on one of them costs no new object."""


Take = Callable[[int, bytes, SocketAddress], WaitingDatagram | None]
"""Receives the number of a socket, a datagram, and its source. Returns the datagram inside with its path; or None if
the datagram needs nothing more, or was dropped and counted."""


class Intake:
    """Receives the datagrams of the peers, and forwards the frames in them once per turn.

    ``links`` has the link of each peer of the core. ``perform`` executes the core's outputs, and passes frames among
    them to :meth:`add`. ``forward`` receives the frames of one peer with the time and the epoch of their reading, and
    drops those from before a pause. Without a pause the frames of a datagram that arrived alone go to the switch
    directly. ``settle`` is called when the core may have new deadlines. ``on_superseded`` counts the frames of
    a peer with several paths that are dropped, because newer ones were delivered. ``on_dropped`` counts a datagram
    with frames of a peer of the core that has no link, such as a relay, with its name.
    """

    def __init__(
        self,
        node: Node,
        stall: StallWatch,
        switch: Switch,
        links: Mapping[LinkedPeer, PeerLink],
        perform: Callable[[list[Output]], None],
        forward: Callable[[PeerLink, list[Frame], float, int], None],
        settle: Callable[[], None],
        on_superseded: Callable[[PeerLink, int], None],
        on_dropped: Callable[[DropReason, str], None],
    ) -> None:
        self._node = node
        self._stall = stall
        self._switch = switch
        self._links = links
        self._perform = perform
        self._forward = forward
        self._settle = settle
        self._on_superseded = on_superseded
        self._on_dropped = on_dropped
        self.takers: dict[bytes, Take] = {}
        """Of the datagrams of relays, by first byte. The core gets all others. It drops those of relays while this
        daemon neither uses relays nor is one."""
        self._loop = asyncio.get_running_loop()
        self._turns = Turns()
        self._handshakes: deque[WaitingDatagram] = deque()
        self._frames: dict[PeerLink, list[Frame]] = {}
        self._cost = 0
        self._paths: dict[tuple[int, SocketAddress], Path] = {}

    def receive(self, socket: int, datagrams: Datagrams, now: float, epoch: int, waited_s: float) -> None:
        """Receive the datagrams of one wake-up from a socket, or let them wait for their senders' turns."""
        paths, takers = self._paths, self.takers
        arrived: list[WaitingDatagram] = []
        for datagram, address in datagrams:
            if takers and (take := takers.get(datagram[:1])) is not None:
                if (taken := take(socket, datagram, address)) is not None:
                    arrived.append(taken)
                continue
            path = paths.get((socket, address))
            if path is None:
                if len(paths) >= MAX_PATHS:
                    paths.clear()
                path = paths[socket, address] = Path(socket, address)
            arrived.append((datagram, path))
        if len(arrived) == 1 and not self._turns.queues:  # a turn of one datagram needs no clock
            outputs = self._node.receive(*arrived[0], now)
            stall = self._stall
            is_fresh = epoch == stall.epoch and monotonic() - stall.turned_at <= STALL_S
            if (
                is_fresh
                and len(outputs) == 1
                and type(outputs[0]) is Deliver
                and (link := self._links.get(outputs[0].peer)) is not None
            ):
                _, payload, order = outputs[0]
                frames = split_payload(payload, link.counters)
                if order:
                    frames = self._pick_newest(outputs[0], link, frames, now)
                elif link.is_repairing:
                    link.note_requests(frames, now)
                if link.recorder is not None:
                    link.record_received(frames, now)
                self._switch.forward(link, frames, now)
            else:
                self._perform(outputs)
                self._deliver(now, epoch)
        else:
            self._receive_in_turn(arrived, now, epoch)
        self._settle()

    def _receive_in_turn(self, arrived: list[WaitingDatagram], now: float, epoch: int) -> None:
        was_busy = self._is_busy
        envelopes = self._receive_handshakes(arrived, now)
        if self._turns.queues:
            self._add_to_turns(envelopes, epoch)
        else:
            arriving = iter(envelopes)
            self._do_turn(arriving, now, epoch)
            self._add_to_turns(list(arriving), epoch)
        if self._is_busy and not was_busy:
            self._loop.call_soon(self._do_turns)

    @property
    def _is_busy(self) -> bool:
        return bool(self._turns.queues or self._handshakes)

    def _receive_handshakes(self, arrived: list[WaitingDatagram], now: float) -> list[WaitingDatagram]:
        """Receive everything but envelopes, which are returned, for at most :data:`HANDSHAKES_S`.

        Handshake messages have budgets of their own in the core. If they waited behind frames, their senders would
        repeat them meanwhile, and a busy daemon would be busier. But when all members of a relay look for it at once,
        they must not keep the envelopes of the first sessions waiting either, or these sessions would be lost again.
        """
        envelopes: list[WaitingDatagram] = []
        handshakes: list[WaitingDatagram] = []
        for waiting in arrived:
            (envelopes if waiting[0][:1] in ENVELOPE_STARTS else handshakes).append(waiting)
        ends_at = thread_time() + HANDSHAKES_S if len(handshakes) > 1 else 0.0
        for number, (datagram, path) in enumerate(handshakes, 1):
            self._perform(self._node.receive(datagram, path, now))
            if number < len(handshakes) and thread_time() >= ends_at:
                self._keep_handshakes(handshakes[number:])
                break
        return envelopes

    def _keep_handshakes(self, rest: list[WaitingDatagram]) -> None:
        """Let handshake messages wait. The oldest are dropped: their senders send new ones."""
        self._handshakes += rest
        while len(self._handshakes) > WAITING_HANDSHAKES:
            self._perform([self._node.refuse(*self._handshakes.popleft())])

    def _receive_newest_handshakes(self, now: float) -> None:
        """Receive handshake messages that wait. The newest is most likely one that its sender still waits for."""
        ends_at = thread_time() + HANDSHAKES_S
        while self._handshakes:
            self._perform(self._node.receive(*self._handshakes.pop(), now))
            if thread_time() >= ends_at:
                break

    def add(self, delivered: Deliver) -> None:
        """Keep frames that the core delivers until the turn is over. Their cost is charged to it."""
        link = self._links.get(delivered.peer)
        if link is None:  # whatever a policy says
            self._on_dropped(DropReason.FRAMES_NOT_ALLOWED, delivered.peer.name)
            return
        frames = split_payload(delivered.payload, link.counters)
        self._cost += cost_of(delivered.payload, len(frames))
        if delivered.order:  # the peer has several paths
            frames = self._pick_newest(delivered, link, frames, monotonic())
        elif link.is_repairing:
            link.note_requests(frames, monotonic())
        if link in self._frames:
            self._frames[link] += frames
        else:
            self._frames[link] = frames

    def _pick_newest(self, delivered: Deliver, link: PeerLink, frames: list[Frame], now: float) -> list[Frame]:
        picked = link.pick_newest(delivered.peer, frames, delivered.order, now)
        if len(picked) < len(frames):
            self._on_superseded(link, len(frames) - len(picked))
        return picked

    def clear(self) -> None:
        """Forget the datagrams that wait."""
        self._turns = Turns()
        self._handshakes.clear()

    def _add_to_turns(self, arrived: list[WaitingDatagram], epoch: int) -> None:
        claimed_sender = self._node.claimed_sender
        for datagram, path in arrived:
            for pushed_out in self._turns.put(claimed_sender(datagram, path), datagram, path, epoch):
                self._perform([self._node.refuse(*pushed_out)])

    def _do_turns(self) -> None:
        """Do one turn of each sender. Then the sockets, the timer and the control socket have theirs."""
        self._stall.turn(monotonic())
        try:
            for turn, epoch in self._turns.round():
                self._do_turn(turn, monotonic(), epoch)
            self._receive_newest_handshakes(monotonic())
        finally:
            if self._is_busy:
                self._loop.call_soon(self._do_turns)
            self._settle()

    def _do_turn(self, arriving: Iterator[WaitingDatagram], now: float, epoch: int) -> None:
        """Receive datagrams until there are no more, or the turn is over. Forward the frames."""
        # Stale datagrams are opened too: their counters must be used up, or an attacker could replay them as new.
        receive, self._cost, ends_at = self._node.receive, 0, thread_time() + TURN_S
        for datagram, path in arriving:
            self._perform(receive(datagram, path, now))
            if self._cost >= TURN_FRAMES or thread_time() >= ends_at:
                break
        self._deliver(now, epoch)

    def _deliver(self, now: float, epoch: int) -> None:
        if epoch != self._stall.epoch:
            self._perform(self._node.pop_held())  # stale as well, even if the peer reports them as new later
        delivered, self._frames = self._frames, {}
        for link, frames in delivered.items():
            self._forward(link, frames, now, epoch)
