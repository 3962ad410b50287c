"""One peer as the shell sees it: its policy, the frames that wait for a slow radio, and the quality of its link."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter, sub

from uavlinkd.config.model import PeerConfig
from uavlinkd.daemon.networks import NetworkBudget
from uavlinkd.daemon.pacer import Pacer
from uavlinkd.mavlink.flows import NewestStates
from uavlinkd.mavlink.frames import Frame, SplitCounters
from uavlinkd.mavlink.own_frames import LinkFigures, worst
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.vehicles import Vehicles
from uavlinkd.protocol.constants import CONFIGURED_PATHS, LOSS_WINDOW_S, NEVER
from uavlinkd.protocol.drops import LinkProblem
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.timers import Deadline, Schedule
from uavlinkd.protocol.wire import MOST_REPORT_BYTES

NOT_ANSWERING_S = 3.0
"""A peer or relay that is silent for this long is reported. A normal start takes less, and tries are more often."""

LOSSY = 0.1
"""A link that loses more than this share of one direction has a high loss,"""
LOSSES = 5
"""if at least so many envelopes are lost."""

RELAYED_LEAST = 3
"""Slots for configured paths that relayed ones have at least: one for each relay."""


class Rates:
    """Bytes a second of a peer and along each of its paths, between the last two measurements."""

    def __init__(self, now: float) -> None:
        self._measured_at = now
        self._totals: dict[Peer | PathState, tuple[int, int]] = {}
        self._rates: dict[Peer | PathState, tuple[float, float]] = {}

    def measure(self, peer: Peer, now: float) -> None:
        """Read the totals of a peer and of the paths that it has now. Call it about once a second."""
        elapsed_s = now - self._measured_at
        if elapsed_s <= 0:
            return
        totals: dict[Peer | PathState, tuple[int, int]] = {
            state: (state.bytes_received, state.bytes_sent) for state in peer.paths.states
        }
        _, sent, received = peer.paths.totals
        totals[peer] = received, sent
        self._rates = {
            one: ((received - self._totals[one][0]) / elapsed_s, (sent - self._totals[one][1]) / elapsed_s)
            for one, (received, sent) in totals.items()
            if (received, sent) != self._totals.get(one, (received, sent))
        }
        self._measured_at, self._totals = now, totals

    def of(self, one: Peer | PathState) -> tuple[float, float]:
        """Bytes received and sent a second; 0 until they were measured twice."""
        return self._rates.get(one, (0.0, 0.0))


@dataclass(slots=True)
class Carriage:
    """What all links of a daemon share."""

    node: Node
    perform: Callable[[list[Output]], None]
    """Executes outputs of the core."""
    settle: Callable[[], None] = lambda: None
    """A deadline may be earlier than before."""
    budgets: Mapping[int, NetworkBudget] = field(default_factory=dict)
    """Of networks, by the number of the socket."""
    waiting: Schedule[PeerLink] = field(default_factory=Schedule)
    """When :meth:`PeerLink.send_waiting` is due."""


class PeerLink:
    """Carries frames to one peer of a node. Compared by identity; times are monotonic seconds."""

    def __init__(self, config: PeerConfig, peer: Peer, carriage: Carriage, now: float) -> None:
        self.config = config
        self.peer = peer
        """Its object in the core."""
        self.name = config.name
        self.policy = config.make_policy()
        self.counters = SplitCounters()
        """Frames and faults in its payloads."""
        self.vehicles = Vehicles()
        """What the autopilots behind it reported last."""
        self.frames_superseded = 0
        """Frames with states older than one already delivered: see :meth:`pick_newest`."""
        self.frames_sent = 0
        """Frames for it that its policy let pass."""
        self.expected_since = now
        """When the daemon began to expect it, at first or again."""
        self.closed_at = -NEVER
        """When its last close arrived."""
        self.relayed: Sequence[Path] = ()
        """The paths to it through relays."""
        self.rates = Rates(now)
        self.figures = LinkFigures(is_up=False, loss_in=0.0, loss_out=0.0, round_trip_s=None)
        """The last result of :meth:`measure`."""
        self.timers = Deadline()
        """When :meth:`send_waiting` is due."""
        self._carriage = carriage
        self._node = carriage.node
        self._perform = carriage.perform
        self._newest = NewestStates()
        self._direct: Sequence[Path] = ()
        self.losses: tuple[tuple[int, int], ...] = ()
        """In and out, how many envelopes were sent recently, and how many of them lost: by the last measurement."""
        self.lossless_at = [now, now]
        """When the loss of each was last not high."""
        self._missing = deque[tuple[int, int, int]](maxlen=round(LOSS_WINDOW_S) + 1)
        """Session, expected, missing; the oldest first."""
        self._sample: tuple[int, tuple[int, int, int, int]] | None = None
        # A session, and its counters at one moment: expected and received here, and as the peer reports.
        self.pacer = Pacer(config.egress, peer, carriage.node, carriage.budgets, self._perform, now)
        """What waits for it."""

    def __repr__(self) -> str:
        return f"PeerLink({self.name})"

    @property
    def silent_since(self) -> float:
        """When something new came from it last, or the daemon began to expect it."""
        return silent_since(self.peer, self.expected_since)

    def leave(self, now: float, *, closes: bool = True) -> None:
        """Cut the peer off at once. ``closes``: it gets a close."""
        self._perform(self._node.remove_peer(self.peer, now, closes=closes))
        self.pacer.clear(now)
        self._carriage.waiting.remove(self)

    @property
    def key(self) -> bytes:
        """The static public key of the peer, by which a relay knows it."""
        return self.config.settings.public_key

    def set_paths(self, paths: Sequence[Path], now: float) -> None:
        """Connect to the peer along these paths, and along the relayed ones."""
        self._direct = paths
        kept = CONFIGURED_PATHS - min(len(self.relayed), RELAYED_LEAST)
        self._node.set_paths(self.peer, [*paths[:kept], *self.relayed, *paths[kept:]], now)

    def set_relayed(self, paths: Sequence[Path], now: float) -> bool:
        """Connect along these paths through relays too. Returns whether they changed."""
        if paths == self.relayed:
            return False
        self.relayed = paths
        self.set_paths(self._direct, now)
        return True

    def change(self, config: PeerConfig, now: float) -> None:
        """Apply other rules to the same peer. Frames that wait are dropped only if budget or delay change."""
        if config.policy != self.config.policy:
            self.policy = config.make_policy()
        if config.egress != self.config.egress:
            self.pacer.change(config.egress, now)
        if config.addresses != self.config.addresses:
            self.expected_since = now
            self.set_paths((), now)  # its new names may have no address: do not connect to the old ones
        self.peer.verify_interval_s = config.settings.link.verify_interval_s
        self._node.offer(self.peer, config.settings.link.features, now)
        self.config = config
        self.follow_paths(now)

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float) -> None:
        """Send frames that arrived together, along several paths, or when budget and coalescing delay allow it.

        ``source``: the port that sent them. ``waited_s``: how long the first of them has waited already.
        """
        self.frames_sent += len(frames)
        if self.pacer.send(frames, now, waited_s):
            self.send_waiting(now)

    @property
    def gather_s(self) -> float:
        """How long frames for it may wait before they are read: they would wait here anyway."""
        settings = self.config.egress
        return 0.0 if settings.budget_bits_s else settings.coalesce_s

    def send_waiting(self, now: float) -> None:
        """Send the waiting frames that are due, and schedule the next ones."""
        try:
            self.pacer.send_waiting(now)
        finally:
            self._set_deadline(now)

    def report_refusals(self, now: float) -> None:
        """Report to the peer which of its frames the policy refuses. Call it about once a second."""
        if not self.peer.is_up or not self.pacer.has_room(MOST_REPORT_BYTES, now):
            return  # totals lose nothing until the next call
        self._perform(self._node.report_refusals(self.peer, self.policy.incoming.changed_totals(), now))

    def report_problems(self, codes: Iterable[int], now: float) -> None:
        """Report this daemon's own problems to the peer. Call it about once a second."""
        if self.peer.is_up and self.pacer.has_room(MOST_REPORT_BYTES, now):
            self._perform(self._node.report_problems(self.peer, codes, now))

    def pick_newest(self, frames: list[Frame], order: int) -> list[Frame]:
        """The frames of an envelope without the states that are superseded. Call it if the peer has several paths.

        ``order``: that of the envelope.
        """
        picked = self._newest.pick(frames, order)
        self.frames_superseded += len(frames) - len(picked)
        return picked

    def _set_deadline(self, now: float) -> None:
        self.timers.next_at = self.pacer.next_deadline(now)
        self._carriage.waiting.update(self)
        self._carriage.settle()

    def follow_paths(self, now: float) -> None:
        """A session began, or other paths are used: envelopes may have another size and other budgets."""
        self.pacer.follow(now)
        self._set_deadline(now)

    def on_down(self, now: float, *, is_closed: bool) -> None:
        """The peer is lost, or has closed the link: drop what waits, which would be old when it is back."""
        if is_closed:  # perhaps to start again at once
            self.expected_since = self.closed_at = now
        self.pacer.clear(now)
        self._set_deadline(now)

    @property
    def is_closed(self) -> bool:
        """Whether nothing new came from the peer after its close."""
        return not self.peer.is_up and self.closed_at >= (self.peer.received_at or 0.0)

    def measure(self, now: float) -> LinkFigures:
        """The quality of the link since the last call. Call it once a second or less often."""
        peer = self.peer
        session, before, self._sample = peer.sessions.current, self._sample, None
        if session is not None:
            counts = session.expected, session.received, *peer.traffic.reported
            self._sample = session.local_index, counts
        self.rates.measure(peer, now)
        loss_in = loss_out = 0.0
        best = peer.paths.best
        missing = peer.missing(now)
        self.note_losses(self._recent_losses(missing, now), now)
        if best is not None and peer.paths.has_several:
            loss_in, loss_out = best.loss_in, best.loss_out  # gaps in the counters say nothing about one path
        elif self._sample is not None and before is not None and before[0] == self._sample[0]:
            expected, received, expected_there, received_there = map(sub, self._sample[1], before[1])
            loss_in = _lost(expected, received)
            # The peer reports now and then. Until the next report the last one is valid.
            loss_out = _lost(expected_there, received_there) if expected_there else self.figures.loss_out
        self.pacer.measure(now)
        self.follow_paths(now)
        self.figures = LinkFigures(
            is_up=peer.is_up,
            loss_in=loss_in,
            loss_out=loss_out,
            round_trip_s=self.round_trip_s,
            demand=self.pacer.demand(now),
            receive_errors=missing,
        )
        return self.figures

    def note_losses(self, losses: tuple[tuple[int, int], ...], now: float) -> None:
        """Note the losses that were measured in and out; none without a path."""
        self.losses = losses
        both = zip(losses or ((0, 0), (0, 0)), self.lossless_at, strict=True)
        self.lossless_at = [before if lost >= max(LOSSES, LOSSY * sent) else now for (sent, lost), before in both]

    def _recent_losses(self, missing: int, now: float) -> tuple[tuple[int, int], ...]:
        """``missing``: all that ever did not arrive."""
        best, session = self.peer.paths.best, self.peer.sessions.current
        if best is None or session is None:
            return ()
        if self._missing and self._missing[0][0] != session.local_index:
            self._missing.clear()
        self._missing.append((session.local_index, session.expected, missing))
        into, out = best.recent_losses(now)
        if not self.peer.paths.has_several:  # then the peer may send few reports
            counted = session.expected - self._missing[0][1], missing - self._missing[0][2]
            into = max(into, counted, key=itemgetter(1))
        return into, out

    @property
    def round_trip_s(self) -> float | None:
        """Of the path in use."""
        best = self.peer.paths.best
        if best is not None and best.srtt_s is not None and self.peer.paths.has_several:
            return best.srtt_s
        return self.peer.round_trip_s

    def problems(self, now: float) -> dict[LinkProblem, int]:
        """The totals of problems that no dropped datagram explains."""
        traffic = self.peer.traffic
        return {
            LinkProblem.ENVELOPES_MISSING: self.peer.missing(now),
            LinkProblem.ENVELOPES_OUT_OF_ORDER: traffic.out_of_order,
            LinkProblem.PATHS_UNPROVEN: self.peer.paths.unproven,
            LinkProblem.ECHOES_UNANSWERED: traffic.echoes_unanswered,
            LinkProblem.HANDSHAKES_UNANSWERED: traffic.handshakes_unanswered,
            LinkProblem.COOKIES_TAKEN: traffic.cookies_taken,
        }


def silent_since(peer: Peer, expected_since: float) -> float:
    """When something new came from a peer last, or ``expected_since`` if that is later."""
    return max(expected_since, peer.received_at or -NEVER)


def radio_figures(links: Iterable[PeerLink]) -> LinkFigures | None:
    """The figures for an autopilot's RADIO_STATUS: the worst link to an operator; without roles, the worst of all.

    An autopilot slows down for its operators, not for a neighbour at the edge of its range.
    """
    by_role = [(link.config.policy.get("role"), link.figures) for link in links]
    chosen = [figures for role, figures in by_role if role == "operator"] or [figures for _, figures in by_role]
    return worst(chosen) if chosen else None


def _lost(expected: int, received: int) -> float:
    return min(1.0, max(0.0, 1.0 - received / expected)) if expected > 0 else 0.0
