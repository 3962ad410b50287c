"""The pacer of one peer: which frame or sealed datagram leaves now, along which path, at whose cost.

Frames wait unsealed for the peer's own budget and those of networks (:mod:`uavlinkd.mavlink.egress`). An envelope is
sealed when it leaves along its first path. Copies have the same bytes, so those for which a path has no room wait
sealed, as repeats do (:mod:`.copies`). A datagram is charged and counted when it leaves. Without a budget, a delay,
several paths and repeats nothing is to be decided, and :class:`.Line` sends. Times are monotonic seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf
from operator import itemgetter, sub
from typing import Final

from uavlinkd.daemon.copies import Copies, Repair
from uavlinkd.daemon.networks import COPIES_SHARE, NetworkBudget, carrier_bytes
from uavlinkd.mavlink.dialect import IDS
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.mavlink.egress.peer_egress import EgressSettings, EnvelopeShape, PeerEgress
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.constants import CRITICAL_ENVELOPE_LIMIT, NEVER
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output, Transmit
from uavlinkd.protocol.path_slots import Route
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.send import CRITICAL, STREAM, batches, send_again
from uavlinkd.protocol.settings import Class, Redundancy

RAW = itemgetter(0)
"""The bytes of a frame."""
_STICKS: Final = frozenset(IDS[name] for name in ("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"))


class Pacer:
    """Decides when and along which paths frames, copies and repeats leave for one peer.

    ``budgets``: of networks, by the number of the socket.
    """

    def __init__(
        self,
        settings: EgressSettings,
        peer: Peer,
        node: Node,
        budgets: Mapping[int, NetworkBudget],
        perform: Callable[[list[Output]], None],
        now: float,
    ) -> None:
        self._settings = settings
        self._peer = peer
        self._node = node
        self._budgets = budgets
        self._perform = perform
        self.egress = PeerEgress(settings, now) if settings.is_needed else None
        """Frames that wait; None if frames never wait."""
        self.copies = Copies(budgets, now)
        self.repair = Repair()
        """Whether critical envelopes are repeated."""
        self.is_plain = self.egress is None
        """Whether frames leave at once, none is repeated, and no budget is charged."""
        self._charged = 0, 0  # datagrams and bytes that the budget was charged for
        self._networks: list[Bucket | None] = []
        self._stream_bytes = 0
        self._measured_at = now

    def send(self, frames: Sequence[Frame], now: float, waited_s: float) -> bool:
        """Send frames that arrived together: at once, or when budgets and the coalescing delay allow it.

        Returns whether :meth:`send_waiting` has something to do.
        """
        if self.egress is not None:
            self.egress.put(frames, now - waited_s)
            return True
        self._send_frames(frames, now)
        return bool(self.copies.waiting)

    def send_waiting(self, now: float) -> None:
        """Send the waiting frames and copies that are due."""
        peer = self._peer
        if self.egress is not None:
            self._charge(now)
            while batch := self.egress.take(now):
                self._send_frames(batch, now)
                self._charge(now)
        if self.copies.waiting:
            usable = [state for state in peer.paths.states if not state.is_off]
            released = self.copies.release(usable, self.repair.left_out, now)
            self._perform([send_again(peer, state, datagram, number) for state, datagram, number in released])

    def next_deadline(self, now: float) -> float:
        """When :meth:`send_waiting` is due."""
        at = NEVER if self.egress is None else self.egress.next_deadline()
        return min(at, self.copies.next_deadline(now)) if self.copies.waiting else at

    def has_room(self, payload_bytes: int, now: float) -> bool:
        """Whether an envelope with this payload may go out now."""
        self._charge(now)
        return self.egress is None or self.egress.has_room(payload_bytes, now)

    def demand(self, now: float) -> float:
        """The bytes sent and dropped over the last seconds, as a share of the tightest budget; 0 without one."""
        self._charge(now)
        return 0.0 if self.egress is None else self.egress.demand(now)

    def _charge(self, now: float) -> None:
        """Charge the peer's own budget for all datagrams that left since the last call, handshakes and echoes too."""
        if self.egress is None:
            return
        charged, self._charged = self._charged, self._peer.paths.totals[:2]
        if self._charged != charged:
            datagrams, size = map(sub, self._charged, charged)
            self.egress.spend(size, now, datagrams=datagrams)

    # Changes.

    def change(self, settings: EgressSettings, now: float) -> None:
        """Another budget or delay. What waits is dropped. What was sent before is not charged."""
        if self.egress is not None:
            self.egress.clear()  # and leave the lines of other peers
        self._settings = settings
        self.egress = PeerEgress(settings, now) if settings.is_needed else None
        self._networks = []
        self._charged = self._peer.paths.totals[:2]
        self._note_plain()

    def _note_plain(self) -> None:
        self.is_plain = self.egress is None and not self.repair.is_on

    def follow(self, now: float) -> None:
        """A session began, or other paths are used: envelopes have another size, frames wait for other networks."""
        peer = self._peer
        if self._budgets:
            self._follow_networks(now)
        session, path = peer.sessions.current, peer.path
        if self.egress is not None and session is not None and path is not None:
            limit = min(session.payload_limit, session.payload_limit_of(peer.paths.longest[Class.STREAM]))
            seal = session.parameters.max_envelope - session.payload_limit
            self.egress.set_shape(EnvelopeShape(limit, seal, carrier_bytes(path)))

    def _follow_networks(self, now: float) -> None:
        route = self._peer.paths.routes[Class.CRITICAL]
        route = tuple(state for state in route if state.works) or route
        budgets = [self._budgets.get(state.path.socket) for state in route]
        networks = [None if budget is None else budget.all for budget in budgets]
        if networks == self._networks or not networks:
            return
        self._networks = networks
        if self.egress is None and networks[0] is not None:
            self.egress = PeerEgress(self._settings, now)
            self._note_plain()
        if self.egress is not None:
            self.egress.set_networks(networks)

    def measure(self, now: float) -> None:
        """Note the rate of the stream, which copies may use too, and the loss of paths. Call it once a second."""
        if now > self._measured_at:
            own_budget = self._settings.budget_bits_s
            most_bytes_s = COPIES_SHARE * own_budget / 8 if own_budget else inf
            self.copies.set_stream_rate(self._stream_bytes / (now - self._measured_at), now, most_bytes_s)
            self._stream_bytes, self._measured_at = 0, now
        peer = self._peer
        is_allowed = peer.is_up and peer.settings.link.redundancy is not Redundancy.NONE
        self.repair.update(peer.paths.routes[Class.CRITICAL], now, is_allowed=is_allowed)
        self._note_plain()

    def clear(self, now: float) -> None:
        """Drop what waits: the peer is lost."""
        self.copies.clear()
        self.repair.end()
        self._note_plain()
        if self.egress is not None:
            self.egress.clear()

    # Envelopes.

    def _send_frames(self, frames: Sequence[Frame], now: float) -> None:
        """Send frames in their order. Consecutive ones that go along the same paths, a run, share envelopes.

        Critical frames that are copied or repeated have envelopes of their own.
        """
        routes, repeats = self._peer.paths.routes, self.repair.is_on
        is_apart = repeats or len(routes[CRITICAL]) > 1
        runs: list[tuple[bool | Route, set[Class], list[Frame]]] = []
        for frame in frames:
            kind = frame.header.kind
            cls = kind.cls
            # Newer states replace repeats of older ones, which must not contain events then.
            run: bool | Route = (repeats and kind.is_state) if is_apart and cls is CRITICAL else routes[cls]
            if not runs or run != runs[-1][0]:
                runs.append((run, set(), []))
            runs[-1][1].add(cls)
            runs[-1][2].append(frame)
        for run, classes, part in runs:
            cls = CRITICAL if CRITICAL in classes else STREAM if STREAM in classes else Class.BULK
            is_copied = isinstance(run, bool) or len(run) > 1
            for envelope in self._envelopes(part, cls) if is_copied else (part,):
                self._send_together(envelope, cls, now)

    def _envelopes(self, frames: list[Frame], cls: Class) -> list[list[Frame]]:
        """Frames that share an envelope, so that it is known which of them are in a copy that waits."""
        session, longest = self._peer.sessions.current, self._peer.paths.longest[cls]
        if session is None:
            return [frames]
        most = CRITICAL_ENVELOPE_LIMIT if cls is CRITICAL else session.max_envelope
        return batches(frames, lambda frame: len(frame.raw), session.payload_limit_of(min(most, longest)))

    def _send_together(self, frames: Sequence[Frame], cls: Class, now: float) -> None:
        """Send frames in one envelope along the paths with room. Its copies for others and its repeats wait.

        Along a single path, if none is repeated, the frames may need several envelopes.
        """
        peer, raws = self._peer, list(map(RAW, frames))
        if peer.paths.best is None and all(frame.header.msgid in _STICKS for frame in frames):
            cls = STREAM  # the core keeps critical frames for the next path, and these would be old then
        if cls is not CRITICAL:
            self._stream_bytes += sum(map(len, raws))
        route, later, session = peer.paths.routes[cls], list[PathState](), peer.sessions.current
        if session is not None and len(route) > 1:
            size = session.envelope_bytes(sum(map(len, raws)))
            route, later = self.copies.divide(peer.paths.carrying(route, size), now)
        outputs = self._node.send(peer, raws, now, cls, route)
        if later or len(route) > 1 or self.repair.is_on:
            critical, transmissions = frames if cls is CRITICAL else None, self.repair.transmissions
            for output in outputs:
                if isinstance(output, Transmit):  # of the one envelope
                    self.copies.add(output.datagram, route, later, critical, transmissions, now)
                    break
        self._perform(outputs)
