"""One peer as the shell sees it: its policy, what waits for it on a slow radio, and how its link does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from uavlinkd.system.addresses import IPV4_UDP_BYTES, IPV6_UDP_BYTES
from uavlinkd.config import Peer as PeerConfig
from uavlinkd.core.constants import NEVER
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output, Path, Transmit
from uavlinkd.core.peer import Peer
from uavlinkd.link.key_change import Graces, KeyPairing, pairings
from uavlinkd.mavlink.egress.coalescing import Coalescer, make_egress
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.mavlink.egress.budgeted import Egress, EnvelopeShape
from uavlinkd.mavlink.frames import Frame, SplitCounters
from uavlinkd.mavlink.radio_status import LinkFigures, worst
from uavlinkd.ops.recorder import TO_PEER, Recorder

UNANSWERED_S = 5.0
"""A peer that is called in vain for this long is worth a line in the log."""
UNCALLED_S = 30.0
"""The same of one that has to call."""

Perform = Callable[[list[Output]], None]


class PeerLink:
    """Carries frames to one peer of a node. Compared by identity; times are monotonic seconds."""

    def __init__(
        self, config: PeerConfig, node: Node, perform: Perform, now: float, recorder: Recorder | None = None
    ) -> None:
        self.config = config
        self.name = config.name
        self.policy = config.make_policy()
        self.counters = SplitCounters()
        """What was found in its payloads."""
        self.egress = make_egress(config.egress, now)
        """Where frames wait; None where nothing makes them wait."""
        self._node = node
        self._perform = perform
        self._recorder = recorder
        self._names = [config.name]  # in the core, the one of the current keys first
        self._previous: dict[str, tuple[KeyPairing, float]] = {}  # the others, and until when they are good
        self._charged: dict[str, tuple[int, int]] = {}  # datagrams and bytes that the budget has been told of
        self._unheard_since = now
        self._is_told = False
        self._sample: _Sample | None = None
        self._measured = now, config.name, 0, 0  # when, what, and the bytes received and sent then
        self.bytes_s = 0.0, 0.0
        """Bytes received and sent a second, at the last :meth:`measure`."""
        self._figures = LinkFigures(is_up=False, loss_in=0.0, loss_out=0.0, round_trip_s=None)

    def __repr__(self) -> str:
        return f"PeerLink({self.name})"

    @property
    def peer(self) -> Peer:
        """The core's side of it: by the current keys, or by those before while only they work."""
        if self._previous:
            for name in self._names:
                if self._node.peers[name].is_up:
                    return self._node.peers[name]
        return self._node.peers[self.name]

    @property
    def accepts_previous_keys(self) -> bool:
        """Whether a key is changing, and the new one not yet confirmed."""
        return bool(self._previous)

    def join(self, now: float, graces: Graces, grace_s: float, *, has_previous_key: bool) -> None:
        """Have the core accept the peer; by previous keys too, for what is left of ``grace_s``."""
        for pairing in pairings(self.config, has_previous_key):
            name = pairing.settings.name
            if name != self.name:
                until = graces.until(pairing, now, grace_s)
                if now >= until:
                    continue
                self._names.append(name)
                self._previous[name] = pairing, until
            self._node.add_peer(pairing.settings, now, by_previous_key=pairing.by_our_previous)

    def leave(self, now: float) -> None:
        """Cut the peer off at once."""
        for name in self._names:
            self._perform(self._node.remove_peer(name, now))

    def give_up_theirs(self, now: float) -> None:
        """Accept the peer's previous key no longer."""
        self._give_up([each for each, _ in self._previous.values() if each.by_their_previous], now)

    def give_up_ours(self, now: float) -> None:
        """Accept our own previous key no longer."""
        self._give_up([each for each, _ in self._previous.values() if each.by_our_previous], now)

    def end_graces(self, now: float, graces: Graces) -> bool:
        """Give up the previous keys that were accepted for long enough; whether there were any."""
        return self._end([each for each, until in self._previous.values() if now >= until], now, graces)

    def confirm(self, now: float, graces: Graces) -> bool:
        """The peer has the current keys: give up all previous ones; whether there were any."""
        return self._end([each for each, _ in self._previous.values()], now, graces)

    def _end(self, gone: Sequence[KeyPairing], now: float, graces: Graces) -> bool:
        """Give these up for as long as the daemon runs: no reload brings them back."""
        for pairing in gone:
            graces.end(pairing)
        self._give_up(gone, now)
        return bool(gone)

    def _give_up(self, gone: Sequence[KeyPairing], now: float) -> None:
        names = [each.settings.name for each in gone]
        self._names = [name for name in self._names if name not in names]
        for name in names:
            del self._previous[name]
        for name in names:  # what comes of it sees none of them any more
            self._perform(self._node.remove_peer(name, now))

    def set_paths(self, paths: Sequence[Path], now: float) -> None:
        """Where to call it."""
        for name in reversed(self._names):  # the last one is who is thought to be at an address
            self._node.set_addresses(name, paths, now)

    def change(self, config: PeerConfig, now: float) -> None:
        """Other rules for the same peer. What waits for it is dropped only where the way of waiting changes."""
        if config.policy != self.config.policy:
            self.policy = config.make_policy()
        if config.egress != self.config.egress:
            self.egress = make_egress(config.egress, now)
            self._charged = {name: self._sent(name) for name in self._names}
        if config.addresses != self.config.addresses:
            self._unheard_since, self._is_told = now, False
            self.set_paths((), now)  # its names may have no address now: it is not called at the old ones
        if config.previous_public_key is None:
            self.give_up_theirs(now)
        for name in self._names:
            self._node.peers[name].verify_interval_s = config.settings.link.verify_interval_s
        self.config = config
        self.on_session()

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float) -> None:
        """Send frames that are here together: at once, or when the budget lets them.

        ``source``: where they came from. ``waited_s``: how long the first of them has waited already.
        """
        if self.egress is None:
            self._give([raw for raw, _ in frames], now)
            return
        self.egress.put(frames, now - waited_s)
        self.send_waiting(now)

    @property
    def gather_s(self) -> float:
        """How long frames for it may wait unread, as they would wait here anyway."""
        return self.egress.settings.coalesce_s if isinstance(self.egress, Coalescer) else 0.0

    def send_waiting(self, now: float) -> None:
        """Send what is due of what waits."""
        if self.egress is None:
            return
        self._charge(self.egress, now)
        while batch := self.egress.take(now):
            self._give(batch, now)
            self._charge(self.egress, now)

    def _give(self, frames: list[bytes], now: float) -> None:
        outputs = self._node.send(self.peer.name, frames, now)
        # Without a session nothing crosses the link.
        if self._recorder is not None and any(isinstance(each, Transmit) for each in outputs):
            self._recorder.add(self.name, frames, TO_PEER, now)
        self._perform(outputs)

    def next_deadline(self) -> float:
        """When :meth:`send_waiting` has something to do."""
        return NEVER if self.egress is None else self.egress.next_deadline()

    def on_session(self) -> None:
        """A session began: its envelopes may be shaped otherwise."""
        session, path = self.peer.sessions.current, self.peer.path
        if self.egress is not None and session is not None and path is not None:
            carrier = IPV6_UDP_BYTES if ":" in path[1] else IPV4_UDP_BYTES
            seal = session.parameters.max_envelope - session.payload_limit
            self.egress.shape = EnvelopeShape(session.payload_limit, seal, carrier)

    def on_down(self, now: float) -> None:
        """The peer is lost: what waits for it would be old when it is back."""
        if self.egress is not None:
            self.egress.clear(now)

    def is_unheard(self, now: float) -> bool:
        """Once each time that the peer is not heard for long: :data:`UNANSWERED_S`, or :data:`UNCALLED_S`."""
        if self.peer.is_up:
            self._unheard_since = now
            self._is_told = False
            return False
        if self._is_told or now - self._unheard_since < (UNANSWERED_S if self.config.addresses else UNCALLED_S):
            return False
        self._is_told = True
        return True

    def measure(self, now: float) -> LinkFigures:
        """How the link does, over the time since the last call; call it once a second or less often."""
        peer = self.peer
        measured_at, name, received, sent = self._measured
        if now > measured_at and name == peer.name:
            elapsed_s = now - measured_at
            self.bytes_s = (
                (peer.traffic.bytes_received - received) / elapsed_s,
                (peer.traffic.bytes_sent - sent) / elapsed_s,
            )
        self._measured = now, peer.name, peer.traffic.bytes_received, peer.traffic.bytes_sent
        before, self._sample = self._sample, _Sample.of(peer)
        loss_in = loss_out = 0.0
        if before is not None and before.index == self._sample.index:
            loss_in = _lost(self._sample.expected - before.expected, self._sample.received - before.received)
            there = self._sample.expected_there - before.expected_there
            # The peer reports now and then; until it does, its last word stands.
            loss_out = (
                _lost(there, self._sample.received_there - before.received_there) if there else self._figures.loss_out
            )
        self._figures = LinkFigures(
            is_up=peer.is_up,
            loss_in=loss_in,
            loss_out=loss_out,
            round_trip_s=peer.round_trip_s,
            demand=0.0 if self.egress is None else self.egress.demand(now),
            receive_errors=peer.missing(now),
        )
        return self._figures

    def disturbances(self, now: float) -> dict[str, int]:
        """What went wrong between here and the peer, and no datagram that came was to blame for.

        It only grows for one peer of the core; by other keys it is another one, and begins anew.
        """
        traffic = self.peer.traffic
        return {
            "envelopes_missing": self.peer.missing(now),
            "envelopes_out_of_order": traffic.out_of_order,
            "challenges_unanswered": traffic.challenges_unanswered,
            "echoes_unanswered": traffic.echoes_unanswered,
            "handshakes_unanswered": traffic.handshakes_unanswered,
            "cookies_taken": traffic.cookies_taken,
        }

    @property
    def figures(self) -> LinkFigures:
        """What :meth:`measure` gave last."""
        return self._figures

    def _charge(self, egress: Egress | Coalescer, now: float) -> None:
        """Tell the budget of everything that went to the peer, handshakes and echoes too."""
        for name in self._names:
            told = self._charged.get(name, (0, 0))
            total = self._sent(name)
            if total != told:
                egress.spend(total[1] - told[1], now, datagrams=total[0] - told[0])
                self._charged[name] = total

    def _sent(self, name: str) -> tuple[int, int]:
        traffic = self._node.peers[name].traffic
        return traffic.datagrams_sent, traffic.bytes_sent


def radio_figures(links: Iterable[PeerLink]) -> LinkFigures | None:
    """What an autopilot is told of its radio: the worst of the links to operators; of all, where no role says who is.

    It slows down for those who watch and command it, not for a neighbour at the edge of its range.
    """
    by_role = [(each.config.policy.get("role"), each.figures) for each in links]
    chosen = [figures for role, figures in by_role if role == "operator"] or [figures for _, figures in by_role]
    return worst(chosen) if chosen else None


class _Sample:
    """Counters of a session at one moment."""

    __slots__ = ("expected", "expected_there", "index", "received", "received_there")

    def __init__(self, index: int, expected: int, received: int, there: tuple[int, int]) -> None:
        self.index = index
        self.expected = expected
        self.received = received
        self.expected_there, self.received_there = there

    @classmethod
    def of(cls, peer: Peer) -> _Sample:
        session = peer.sessions.current
        if session is None:
            return cls(0, 0, 0, (0, 0))
        return cls(session.local_index, session.expected, session.received, peer.traffic.reported)


def _lost(expected: int, received: int) -> float:
    return min(1.0, max(0.0, 1.0 - received / expected)) if expected > 0 else 0.0
