"""The line: what a frame passes in this daemon between the socket where it is read and the socket where it is sent.

Out: a client's frames → :meth:`Line.forward` → the core seals them → :meth:`Line.perform` sends. In: a peer's
datagram → :meth:`Line.receive` → the core opens it → :meth:`Line.perform` → :meth:`Line.forward` → the client's
socket. There is no task, queue, lock or ``await`` between. What is rare has one branch each: to the switch, which
decides about the first frame of a flow, and to :class:`.FrameCarrier`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import repeat
from typing import Final

from uavlinkd.daemon.journal import DaemonJournal, ShellReason
from uavlinkd.daemon.pacer import RAW
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.daemon.peer_sockets import PeerSockets
from uavlinkd.daemon.switch import Port, Switch, owner_of
from uavlinkd.daemon.turns import cost_of
from uavlinkd.io.reader import Datagrams
from uavlinkd.mavlink.frames import Frame, parse_frames, pass_faults
from uavlinkd.mavlink.sendings import MAX_FRAMES_REMEMBERED
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Deliver, LinkedPeer, Output, Transmit
from uavlinkd.protocol.path import Path, SocketAddress
from uavlinkd.protocol.relay_records import RELAYED_START
from uavlinkd.protocol.send import STREAM, send_frames
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import report
from uavlinkd.system.stall import STALL_S, StallWatch

MAX_PATHS: Final = 1024
"""Paths of a socket's received datagrams that are remembered: a frame on one of them costs no new object."""


class Line:
    """Carries datagrams and frames, and calls :class:`.FrameCarrier` for what is rare. It drops what is stale."""

    on_output: Callable[[Output], object]
    """Executes an output of the core that is no datagram and no frame."""
    on_several: Callable[[int, Datagrams, float, int], object]
    """Receives datagrams that came together, or while others wait."""
    unwrap: Callable[[int, bytes, SocketAddress], tuple[bytes, Path] | None]
    """Returns the datagram inside one of a relay or a member, with its path, unless it was handled or dropped."""
    on_read: Callable[[], object] | None = None
    """Called after each read: of a relay, which answers several datagrams at once."""
    drop_held: Callable[[], object]
    """Drops what the core holds: it is from before a pause."""
    arm: Callable[[], object]
    """Sets the timer to the next deadline, which is earlier than :attr:`timer_at`."""

    def __init__(
        self,
        switch: Switch,
        stall: StallWatch,
        drops: DaemonJournal,
        node: Node,
        links: Mapping[LinkedPeer, PeerLink],
        sockets: PeerSockets,
    ) -> None:
        self.switch = switch
        self.timer_at = float("-inf")
        """When the timer of the daemon expires."""
        self.read_at, self.epoch = 0.0, 0
        """Of the datagrams that are received now."""
        self.is_busy = False
        """Whether datagrams wait for their senders' turns."""
        self.is_turn = False
        """Whether frames gather until the end of a turn,"""
        self.cost = 0
        """and what those of this turn cost so far."""
        self._stall = stall
        self._drops = drops
        self._node = node
        self._schedule = node.schedule
        self._links = links
        self._sockets, self._senders = sockets, sockets.senders
        self.unwrap = lambda socket, data, source: (data, self.path_of(socket, source))  # no relay is configured
        self._paths = defaultdict[int, dict[SocketAddress, Path]](dict)  # by the socket
        self._frames: dict[PeerLink, list[Frame]] = {}  # delivered, but not forwarded yet

    def receive(self, socket: int, datagrams: Datagrams, now: float, epoch: int, waited_s: float) -> None:
        """Receive the datagrams of one wake-up from a socket, or let them wait for their senders' turns."""
        if len(datagrams) == 1 and not self.is_busy:
            self.read_at, self.epoch = now, epoch
            datagram, address = datagrams[0]
            try:
                if datagram[:1] != RELAYED_START:
                    path = self._paths[socket].get(address) or self.path_of(socket, address)
                    self.perform(self._node.receive(datagram, path, now))
                elif (inside := self.unwrap(socket, datagram, address)) is not None:
                    self.perform(self._node.receive(*inside, now))
            except Exception as error:  # a fault costs this datagram
                report(error)
            if epoch != self._stall.epoch:
                self.drop_held()
        else:
            self.on_several(socket, datagrams, now, epoch)
        if self.on_read is not None:
            self.on_read()

    def path_of(self, socket: int, address: SocketAddress) -> Path:
        """The path along which a datagram came."""
        paths = self._paths[socket]
        path = paths.get(address)
        if path is None:
            if len(paths) >= MAX_PATHS:
                paths.clear()
            path = paths[address] = Path(socket, address)
        return path

    def perform(self, outputs: Sequence[Output]) -> None:
        """Execute outputs of the core. Frames that it delivers are forwarded at once, or at the end of the turn.

        A fault costs one output, or the frames of one link.
        """
        for output in outputs:
            try:
                if isinstance(output, Transmit):
                    datagram, (socket, address) = output
                    try:
                        self._senders[socket](datagram, address)
                    except OSError as error:
                        self._sockets.on_send_error(socket, datagram, address, error)
                elif isinstance(output, Deliver):
                    peer, payload, order = output
                    link = self._links.get(peer)
                    if link is None:  # whatever a policy says
                        self.drop_datagram(DropReason.FRAMES_NOT_ALLOWED, peer.name)
                        continue
                    # As split_payload, without one call.
                    frames: list[Frame] = []
                    position, fault = parse_frames(payload, 0, frames, link.counters, is_expected=True)
                    if fault is not None:
                        pass_faults(payload, position, fault, frames, link.counters)
                    if self.is_turn:
                        self.cost += cost_of(payload, len(frames))
                    if order:  # the peer has several paths
                        came, frames = len(frames), link.pick_newest(frames, order)
                        if count := came - len(frames):
                            reason = ShellReason.SUPERSEDED
                            self._drops.add("frames_dropped", reason, link.name, count, monotonic())
                    if len(outputs) == 1 and not self.is_turn:
                        self.forward(link, frames, self.read_at, self.epoch)
                    elif link in self._frames:
                        self._frames[link] += frames
                    else:
                        self._frames[link] = frames
                else:
                    self.on_output(output)
            except Exception as error:
                report(error)
        if self._frames and not self.is_turn:
            delivered, self._frames = self._frames, {}
            for link, frames in delivered.items():
                if link.peer in self._links:  # else it was revoked since these frames came
                    try:
                        self.forward(link, frames, self.read_at, self.epoch)
                    except Exception as error:
                        report(error)
        if self._schedule.next_at < self.timer_at:
            self.arm()

    def drop_datagram(self, reason: DropReason, name: str = "", path: Path | None = None) -> None:
        """Count a datagram that the core does not drop."""
        self._node.drops[reason] += 1
        fact = "" if path is None else ("", path)
        self._drops.add("datagrams_dropped", reason, name, 1, monotonic(), fact)

    def forward(self, source: Port, frames: Sequence[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        """Send frames of ``source`` where they belong. A frame that a policy refuses is counted and dropped.

        ``epoch``: when they were read. ``waited_s``: how long the first of them has waited for the others.
        """
        stall, at = self._stall, monotonic()
        if at - stall.turned_at > STALL_S:  # the process may have paused after it read them
            stall.turn(at)
        if epoch != stall.epoch:
            stall.dropped[owner_of(source)] += len(frames)
            self._drops.add("frames_dropped", ShellReason.STALE, owner_of(source), len(frames), now)
            return
        switch = self.switch
        if now >= switch.router.valid_until:
            switch.refresh(now)
        known = switch.ports[source]
        flows, sendings = known.flows, switch.router.sendings
        is_alone = len(frames) == 1
        batches: dict[Port, list[Frame]] = {}
        of_one: Iterable[tuple[Port, Sequence[Frame]]] = ()
        for frame in frames:
            try:
                raw, header = frame
                flow = flows.get(header)
                if flow is None:
                    ports = switch.route(frame, source, now)
                else:
                    ports, comes_once, is_conditional = flow
                    if is_conditional:
                        ports = switch.judge(frame, source, flow, now)
                    elif not comes_once:
                        seen = sendings.seen
                        is_known = raw in seen or raw in sendings.seen_before
                        if is_known or now >= sendings.half_ends_at or len(seen) >= MAX_FRAMES_REMEMBERED:
                            if not sendings.is_new(frame, source, ports, now):
                                continue
                        else:  # as is_new() does, without a call
                            sendings.count += 1
                            seen[raw] = source, now, ports, sendings.count
            except Exception as error:  # a fault costs this frame: no policy let it pass
                report(error)
                continue
            if is_alone:
                of_one = zip(ports, repeat(frames))
                break
            for port in ports:
                if port in batches:
                    batches[port].append(frame)
                else:
                    batches[port] = [frame]
        for port, batch in of_one if is_alone else batches.items():
            try:
                if isinstance(port, PeerLink) and port.pacer.is_plain and not port.peer.paths.is_multiple:
                    peer = port.peer
                    port.frames_sent += len(batch)
                    out = send_frames(peer, [raw] if is_alone else list(map(RAW, batch)), now, STREAM)
                    timers = peer.timers
                    if timers.next_at < timers.scheduled_at:  # as Node.send() does, without a call
                        self._schedule.update(peer)
                    self.perform(out)
                else:
                    port.send(batch, known.source, now, waited_s)
            except Exception as error:
                report(error)
