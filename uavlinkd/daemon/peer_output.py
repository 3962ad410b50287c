"""Frames that leave for one peer with a budget, a delay, or several paths. Without these, :class:`.PeerLink` sends.

Frames wait unsealed for the peer's own budget and those of networks (:mod:`uavlinkd.mavlink.egress`). Copies for
other paths wait sealed (:mod:`.copies`). Times are monotonic seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
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
from uavlinkd.protocol.paths import Route
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.settings import Class, Redundancy

RAW = itemgetter(0)
"""The bytes of a frame."""
_STICKS: Final = frozenset(IDS[name] for name in ("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"))


class PeerOutput:
    """What waits for one peer. ``budgets``: of networks, by the number of the socket."""

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
        self._critical_limit = CRITICAL_ENVELOPE_LIMIT  # of the payload; set for each session
        self._stream_bytes = 0
        self._measured_at = now

    def send(self, frames: Sequence[Frame], now: float, waited_s: float) -> bool:
        """Send frames that arrived together: at once, or when budgets and the coalescing delay allow it.

        Returns whether :meth:`send_waiting` has something to do.
        """
        if self.egress is not None:
            self.egress.put(frames, now - waited_s)
            return True
        self._send_runs(frames, now)
        return bool(self.copies.waiting)

    def send_waiting(self, now: float) -> None:
        """Send the waiting frames and copies that are due."""
        peer = self._peer
        if self.egress is not None:
            self.charge(now)
            while batch := self.egress.take(now):
                self._send_runs(batch, now)
                self.charge(now)
        if self.copies.waiting:
            usable = {
                state.path for state in peer.paths.states if not state.is_off and state not in self.repair.left_out
            }
            released = self.copies.release(usable, now)
            for (datagram, path, _), number in released:
                if number == 1:
                    peer.recount(path, 1, len(datagram))
                else:
                    peer.note_repeat(path, number, datagram)
            self._perform([transmit for transmit, _ in released])

    def next_deadline(self, now: float) -> float:
        """When :meth:`send_waiting` is due."""
        at = NEVER if self.egress is None else self.egress.next_deadline()
        return min(at, self.copies.next_deadline(now)) if self.copies.waiting else at

    def has_room(self, payload_bytes: int, now: float) -> bool:
        """Whether an envelope with this payload may go out now."""
        return self.egress is None or self.egress.has_room(payload_bytes, now)

    def charge(self, now: float) -> None:
        """Charge the peer's own budget for all datagrams to it, handshakes and echoes too."""
        if self.egress is None:
            return
        charged, self._charged = self._charged, self._sent()
        if self._charged != charged:
            datagrams, size = map(sub, self._charged, charged)
            self.egress.spend(size, now, datagrams=datagrams)

    def _sent(self) -> tuple[int, int]:
        return self._peer.paths.totals[:2]

    # Changes.

    def change(self, settings: EgressSettings, now: float) -> None:
        """Another budget or delay. What waits is dropped. What was sent before is not charged."""
        if self.egress is not None:
            self.egress.clear()  # and leave the lines of other peers
        self._settings = settings
        self.egress = PeerEgress(settings, now) if settings.is_needed else None
        self._networks = []
        self._charged = self._sent()
        self._note_plain()

    def _note_plain(self) -> None:
        self.is_plain = self.egress is None and not self.repair.is_on

    def follow(self, now: float) -> None:
        """A session began, or other paths are used: envelopes have another size, frames wait for other networks."""
        peer = self._peer
        if self._budgets:
            self._follow_networks(now)
        session, path = peer.sessions.current, peer.path
        if session is None or path is None:
            return
        self._critical_limit = session.payload_limit_of(
            min(CRITICAL_ENVELOPE_LIMIT, peer.paths.longest[Class.CRITICAL])
        )
        if self.egress is not None:
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

    def _send_runs(self, frames: Sequence[Frame], now: float) -> None:
        """Send frames in their order. Consecutive ones that go along the same paths, a run, share envelopes.

        Critical frames that are copied or repeated have envelopes of their own.
        """
        routes, repeats = self._peer.paths.routes, self.repair.is_on
        is_apart = repeats or len(routes[Class.CRITICAL]) > 1
        runs: list[tuple[bool | Route, set[Class], list[Frame]]] = []
        for frame in frames:
            kind = frame.header.kind
            cls = kind.cls
            # Newer states replace repeats of older ones, which must not contain events then.
            run: bool | Route = (repeats and kind.is_state) if is_apart and cls is Class.CRITICAL else routes[cls]
            if not runs or run != runs[-1][0]:
                runs.append((run, set(), []))
            runs[-1][1].add(cls)
            runs[-1][2].append(frame)
        for run, classes, part in runs:
            cls = next(cls for cls in Class if cls in classes)  # the most important one
            for envelope in self._envelopes(part) if isinstance(run, bool) else (part,):
                self._send_part(envelope, cls, now)

    def _envelopes(self, frames: Sequence[Frame]) -> Iterator[Sequence[Frame]]:
        """Frames that share an envelope, so that it is known which of them are in a copy that waits."""
        part: list[Frame] = []
        size = 0
        for frame in frames:
            size += len(frame.raw)
            if size > self._critical_limit and part:
                yield part
                part, size = [], len(frame.raw)
            part.append(frame)
        yield part

    def _send_part(self, frames: Sequence[Frame], cls: Class, now: float) -> None:
        raws = list(map(RAW, frames))
        if self._peer.paths.best is None and all(frame.header.msgid in _STICKS for frame in frames):
            cls = Class.STREAM  # the core keeps critical frames for the next path, and these would be old then
        outputs = self._node.send(self._peer, raws, now, cls)
        if cls is not Class.CRITICAL:
            self._stream_bytes += sum(map(len, raws))
        if len(outputs) > 1:
            outputs = self._pick_copies(outputs, frames if cls is Class.CRITICAL else None, now)
        if cls is Class.CRITICAL and self.repair.is_on:
            for datagram, sent in _by_datagram(outputs).items():  # along the same paths
                paths = [transmit.path for transmit in sent]
                self.copies.repeat(datagram, paths, frames, self.repair.transmissions, now)
        self._perform(outputs)

    def _pick_copies(self, outputs: Sequence[Output], frames: Sequence[Frame] | None, now: float) -> list[Output]:
        """The outputs without the datagrams that have to wait or are dropped."""
        left_out = set[Transmit]()
        for envelope in _by_datagram(outputs).values():
            if len(envelope) > 1:
                left_out |= {*envelope} - {*self.copies.pick(envelope, frames, now)}
        for transmit in left_out:
            self._peer.recount(transmit.path, -1, -len(transmit.datagram))
        return [output for output in outputs if not isinstance(output, Transmit) or output not in left_out]


def _by_datagram(outputs: Sequence[Output]) -> dict[bytes, list[Transmit]]:
    """What is sent, with all copies of an envelope together."""
    transmits: dict[bytes, list[Transmit]] = {}
    for output in outputs:
        if isinstance(output, Transmit):
            transmits.setdefault(output.datagram, []).append(output)
    return transmits
