"""Carries datagrams and frames: reads what peers sent, executes the outputs of the core, and keeps the one timer.

Between reading and sending a frame there is no task, queue, lock or ``await``. Frames wait only for a slow radio's
budget, for a slow client, or for their sender's turn while the daemon is busy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable, Iterator
from time import thread_time
from typing import Final

from uavlinkd.daemon.features import WaitingDatagram
from uavlinkd.daemon.parts import DaemonParts
from uavlinkd.daemon.peer_link import Carriage, PeerLink
from uavlinkd.daemon.peers import Peers
from uavlinkd.daemon.turns import Turns
from uavlinkd.io.reader import Datagrams
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import PEERS_AT_ONCE
from uavlinkd.protocol.outputs import Deliver, Output, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.relay_records import RELAYED_START
from uavlinkd.protocol.timers import Schedule
from uavlinkd.protocol.wire import ENVELOPE_STARTS
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import report, run

HANDSHAKES_S: Final = 0.01
"""CPU time for handshake messages before the envelopes have their turn: about twenty of them."""
WAITING_HANDSHAKES: Final = 1024
"""Handshake messages that wait, at most: what is handled in half a second, one of each member of a large relay."""
LOOP_TICK_S: Final = 0.001
"""A loop may fire a timer up to one tick of its clock early. The timer is set later by this."""
TURN_S: Final = 0.003
"""The longest turn of one sender, without the delivery of its frames. Another sender's frames wait for a few turns,
which is far below a radio's delay. It is CPU time: by the wall clock each turn would end after one datagram when
other processes use the processor."""
TURN_FRAMES: Final = 300
"""Frames that end a turn too, by :func:`cost_of`: the delivery of a frame costs as much as reading it."""


class FrameCarrier:
    """Moves datagrams and frames between the parts of a daemon. It adds the peers to them."""

    def __init__(self, parts: DaemonParts) -> None:
        self._parts = parts
        self._node = parts.node
        self._stall = parts.stall
        self._links = parts.link_of
        self._line = line = parts.line
        self.perform = line.perform
        line.on_output, line.on_several = self._on_output, self._receive_several
        line.drop_held, line.arm = self._drop_held, self.arm
        self._loop = asyncio.get_running_loop()
        self._waiting = Schedule[PeerLink]()
        carriage = Carriage(parts.node, self.perform, self.settle, parts.peer_sockets.budgets, self._waiting)
        self.peers = Peers(parts, carriage)
        self._turns = Turns()
        self._handshakes: dict[Hashable, WaitingDatagram] = {}  # that wait, the newest of each source
        self._turned_at = 0.0  # when a round of turns ended last
        self._timer: asyncio.TimerHandle | None = None
        line.timer_at = NEVER

    # Datagrams in.

    def _receive_several(self, socket: int, datagrams: Datagrams, now: float, epoch: int) -> None:
        """Receive datagrams, or let them wait for their senders' turns."""
        arrived: list[WaitingDatagram] = []
        for datagram, address in datagrams:
            if datagram[:1] != RELAYED_START:
                arrived.append((datagram, self._line.path_of(socket, address)))
                continue
            try:
                inside = self._line.unwrap(socket, datagram, address)
            except Exception as error:
                report(error)
            else:
                arrived += [] if inside is None else [inside]
        if arrived:
            self._receive_arrived(arrived, now, epoch)

    def _receive_arrived(self, arrived: list[WaitingDatagram], now: float, epoch: int) -> None:
        was_busy = self._is_busy
        try:
            envelopes = self._receive_handshakes(arrived, now, epoch)
            if not self._turns.queues:
                arriving = iter(envelopes)
                self._do_turn(arriving, now, epoch)
                envelopes = list(arriving)
            for datagram, path in envelopes:
                run(self._wait, datagram, path, epoch)
        finally:  # an exception must not leave what waits without a turn
            self._line.is_busy = self._is_busy
            if self._is_busy and not was_busy:
                self._loop.call_soon(self._do_turns)

    def _wait(self, datagram: bytes, path: Path, epoch: int) -> None:
        sender = self._node.claimed_sender(datagram, path)
        for pushed_out in self._turns.put(sender, datagram, path, epoch):
            self.perform((self._node.refuse(*pushed_out),))

    @property
    def _is_busy(self) -> bool:
        return bool(self._turns.queues or self._handshakes)

    def _receive_handshakes(self, arrived: list[WaitingDatagram], now: float, epoch: int) -> list[WaitingDatagram]:
        """Receive everything but envelopes, which are returned, for at most :data:`HANDSHAKES_S`.

        Handshake messages have budgets of their own in the core. If they waited behind frames, their senders would
        repeat them meanwhile, and a busy daemon would be busier. But when all members of a relay look for it at once,
        they must not keep the envelopes of the first sessions waiting either, or these sessions would be lost again.
        """
        envelopes: list[WaitingDatagram] = []
        was_waiting = bool(self._handshakes)
        for datagram, path in arrived:
            if datagram[:1] in ENVELOPE_STARTS:
                envelopes.append((datagram, path))
            else:
                run(self._hold_handshake, datagram, path, now)
        if not was_waiting:
            self._line.read_at, self._line.epoch = now, epoch
            self._do_handshakes()
        return envelopes

    def _hold_handshake(self, datagram: bytes, path: Path, now: float) -> None:
        if (dropped := self._node.screen(datagram, path, now)) is not None:
            self.perform((dropped,))
            return
        # A sender repeats its initiation with other keys. The newest takes the place of the one before it.
        waiting, key = self._handshakes, self._node.handshake_source(datagram, path, now)
        if key is None:
            self._do(datagram, path, now)
            return
        if (before := waiting.get(key)) is not None:
            self.perform((self._node.refuse(*before),))
        elif len(waiting) >= WAITING_HANDSHAKES:
            self.perform((self._node.refuse(*waiting.pop(next(iter(waiting)))),))
        waiting[key] = datagram, path

    def _do_handshakes(self) -> None:
        """Receive handshake messages that wait, the first source first, for at most :data:`HANDSHAKES_S`."""
        ends_at = thread_time() + HANDSHAKES_S if len(self._handshakes) > 1 else 0.0
        while self._handshakes:
            datagram, path = self._handshakes.pop(next(iter(self._handshakes)))
            run(self._do, datagram, path, self._line.read_at)
            if self._handshakes and thread_time() >= ends_at:
                break

    def _do(self, datagram: bytes, path: Path, now: float) -> None:
        self.perform(self._node.receive(datagram, path, now, is_screened=True))

    def _do_turns(self) -> None:
        """Do one turn of each sender. Then the sockets, the timer and the control socket have theirs."""
        try:
            self._stall.turn(monotonic())
            for turn, epoch in self._turns.round():
                self._do_turn(turn, monotonic(), epoch)
            self._line.read_at, self._line.epoch = monotonic(), self._stall.epoch
            self._do_handshakes()
        finally:
            self._turned_at = monotonic()
            self._line.is_busy = self._is_busy
            if self._is_busy:
                self._loop.call_soon(self._do_turns)
            if self._line.on_read is not None:
                self._line.on_read()

    def _do_turn(self, arriving: Iterator[WaitingDatagram], now: float, epoch: int) -> None:
        """Receive datagrams until there are no more, or the turn is over. Then forward their frames."""
        # Stale datagrams are opened too: their counters must be used up, or an attacker could replay them as new.
        line = self._line
        line.read_at, line.epoch, line.cost, line.is_turn = now, epoch, 0, True
        ends_at = thread_time() + TURN_S
        try:
            for datagram, path in arriving:
                try:
                    self.perform(self._node.receive(datagram, path, now))
                except Exception as error:
                    report(error)
                if self._line.cost >= TURN_FRAMES or thread_time() >= ends_at:
                    break
        finally:
            self._line.is_turn = False
        run(self.perform, ())
        if epoch != self._stall.epoch:
            self._drop_held()

    def _drop_held(self) -> None:
        """Frames that the core holds are stale as well, even if the peer reports them as new later."""
        self.perform(self._node.pop_held())

    # Outputs of the core.

    def _on_output(self, output: Output) -> None:
        """Execute an output that is no datagram and no frame."""
        if isinstance(output, o.Dropped):
            now = monotonic()
            self._parts.journal.add_dropped(output, now)
            self._parts.evidence.add_dropped(output, now)
        elif isinstance(output, o.RecordReceived):
            self._on_record(output)
        elif isinstance(output, o.CertificateShown):
            assert self._parts.fleet is not None, "only a member takes certificates"
            self.perform(self._parts.fleet.answer(output, self._line.read_at))
        elif not isinstance(output, Deliver | Transmit):
            self._on_event(output)

    def _on_record(self, received: o.RecordReceived) -> None:
        owners = (feature for feature in self._parts.features if isinstance(received.record, feature.records))
        owner = next(owners, None)
        reason = DropReason.UNEXPECTED_RECORD if owner is None else owner.on_record(received, monotonic())
        if reason is not None:
            self._line.drop_datagram(reason, received.peer.name, received.path)
        self.arm()

    def _on_event(self, event: o.Event) -> None:
        now, parts = monotonic(), self._parts
        for feature in parts.features:
            run(feature.on_event, event, now)
        if isinstance(event, o.PeerAdmitted | o.PeerExpired):  # no other part knows it yet
            return
        if self._handshakes and isinstance(event, o.SessionEstablished):  # its peer waits for no other answer
            for key in self._node.initiations_from(event.path):
                if (waiting := self._handshakes.pop(key, None)) is not None:
                    self.perform((self._node.refuse(*waiting),))
        link = self._links.get(event.peer)
        if link is not None and not isinstance(event, o.PathSuspected):
            run(parts.journal.write, event, now)
            if isinstance(event, o.PeerLost | o.PeerClosed):
                link.on_down(now, is_closed=isinstance(event, o.PeerClosed))
            elif not isinstance(event, o.PeerUp):
                link.follow_paths(now)
        self.arm()

    # Time.

    def send_waiting(self) -> None:
        """A connection takes frames again, perhaps those of any peer."""
        now = monotonic()
        for link in self._waiting.pop(NEVER):
            link.send_waiting(now)

    def settle(self) -> None:
        """The core or a link may have an earlier deadline than the timer."""
        if self._node.next_deadline() < self._line.timer_at or self._waiting.next_at < self._line.timer_at:
            self.arm()

    def arm(self) -> None:
        """Set the one timer to the next deadline. It is moved only to an earlier time: firing too early is cheap."""
        of_features = (feature.next_at for feature in self._parts.features)
        deadline = min(self._node.next_deadline(), self._waiting.next_at, *of_features)
        if deadline < self._line.timer_at:
            if self._timer is not None:
                self._timer.cancel()
            self._line.timer_at = deadline
            self._timer = self._loop.call_later(max(0.0, deadline - monotonic()) + LOOP_TICK_S, self._on_timer)

    def _on_timer(self) -> None:
        now, self._line.timer_at = monotonic(), -NEVER  # nothing sets the timer meanwhile
        try:
            self._stall.turn(now)
            for _ in range(PEERS_AT_ONCE):
                if now < self._node.next_deadline():
                    break
                run(self._perform_of, self._node.handle_next, now)  # a fault costs one peer its timers
            for link in self._waiting.pop(now):
                run(link.send_waiting, now)
            for feature in self._parts.features:
                if now >= feature.next_at:
                    run(feature.do_due, now)
        finally:
            self._line.timer_at = NEVER
            self.arm()

    def _perform_of(self, source: Callable[[float], list[Output]], now: float) -> None:
        self.perform(source(now))

    def waiting(self, now: float) -> dict[Hashable, float]:
        """The work that waits here, each with a time that changes when some of it is done."""
        work: dict[Hashable, float] = {}
        if self._is_busy:
            work["turns"] = self._turned_at
        if (deadline := self._node.next_deadline()) < now:
            work["timers"] = deadline
        return work

    def stop(self) -> None:
        """Forget the datagrams that wait, close the sessions with the peers, and do nothing more."""
        self._turns = Turns()
        self._handshakes.clear()
        self.perform(self._node.close(monotonic()))
        if self._timer is not None:
            self._timer.cancel()
        self._line.timer_at = -NEVER
