"""Two daemons' peer links over several one-way-delayed radios, with the real core, on virtual time."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from heapq import heappop, heappush
from typing import NamedTuple

from tests.io.clients import PASSES
from tests.policies import TRUSTED
from tests.protocol.harness import KEY_A, KEY_B, seeded
from uavlinkd.config.model import PeerConfig
from uavlinkd.daemon.networks import NetworkBudget
from uavlinkd.daemon.peer_link import Carriage, PeerLink
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.frames import Frame, split_payload
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Deliver, Output, PathChanged, PathStateChanged, SessionEstablished, Transmit
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.timers import Schedule

_PRIVATE = {
    "alpha" if KeyPair(private).public == KEY_A.public else "bravo": private for private in (b"\1" * 32, b"\2" * 32)
}


class Radio(NamedTuple):
    """One way of a network: delay in seconds, and the share of datagrams that it loses."""

    delay_s: float
    loss: float = 0.0
    budget_bits_s: int = 0
    """0: none. Both ends have the same."""
    is_relayed: bool = False
    """Whether the path leads through a relay."""
    jitter_s: float = 0.0
    """A datagram takes up to so much longer. A radio keeps the order."""


class Sent(NamedTuple):
    """A datagram on the air."""

    at: float
    radio: int
    datagram: bytes


class End:
    """One daemon: its node, its link to the other, and what crossed both."""

    def __init__(self, network: Network, name: str, settings: PeerSettings, egress: EgressSettings) -> None:
        self.name = name
        self.node = Node(Secret(_PRIVATE[name]), seeded(len(settings.name) + (name == "alpha")), 0.0)
        self.schedule = Schedule[PeerLink]()
        config = PeerConfig(settings, (), TRUSTED, egress)
        self.budgets = {
            number: NetworkBudget(radio.budget_bits_s, 0.0)
            for number, radio in enumerate(network.radios)
            if radio.budget_bits_s
        }
        self.node.facts.set_budgets({number: budget.bits_s for number, budget in self.budgets.items()})
        carriage = Carriage(self.node, self.perform, budgets=self.budgets, waiting=self.schedule)
        self.link = PeerLink(config, self.node.add_peer(settings, 0.0), carriage, 0.0)
        self._housekeeping_at = 1.0
        self.delivered: list[Frame] = []
        self.delivered_at: list[float] = []
        self.sent: list[Sent] = []
        self.on_frame: Callable[[Frame], None] | None = None
        """Called with each delivered frame."""
        self._network = network

    @property
    def peer(self) -> Peer:
        """The state kept for the other side."""
        return self.link.peer

    def perform(self, outputs: Sequence[Output]) -> None:
        """What a daemon does with the core's outputs."""
        now = self._network.now
        for output in outputs:
            if isinstance(output, Transmit):
                self.sent.append(Sent(now, output.path.socket, output.datagram))
                if (budget := self.budgets.get(output.path.socket)) is not None:
                    budget.charge(output.datagram, output.path, now)
                self._network.transmit(self, output.datagram, output.path)
            elif isinstance(output, Deliver):
                frames = split_payload(output.payload, self.link.counters)
                if output.order:
                    frames = self.link.pick_newest(frames, output.order)
                self.delivered += frames
                self.delivered_at += [now] * len(frames)
                if self.on_frame is not None:
                    for frame in frames:
                        self.on_frame(frame)
            elif isinstance(output, PathChanged | PathStateChanged | SessionEstablished):
                self.link.follow_paths(now)

    def send(self, *frames: Frame) -> None:
        """Frames that local clients sent together."""
        self.link.send(frames, PASSES, self._network.now, 0.0)

    def next_deadline(self) -> float:
        """When :meth:`handle_timeout` is due."""
        return min(self.node.next_deadline(), self.schedule.next_at, self._housekeeping_at)

    def handle_timeout(self, now: float) -> None:
        """Do what is due."""
        self.perform(self.node.handle_timeout(now))
        for link in self.schedule.pop(now):
            link.send_waiting(now)
        if now >= self._housekeeping_at:
            self._housekeeping_at = now + 1.0
            self.link.measure(now)


class Network:
    """Two ends and the radios between them. ``alpha`` has the addresses of ``bravo``."""

    def __init__(
        self,
        radios: Sequence[Radio],
        link: Link | None = None,
        egress: Mapping[str, EgressSettings] | None = None,
        seed: int = 1,
    ) -> None:
        self.radios = list(radios)
        self.now = 0.0
        link, egress = link or Link(), egress or {}
        self.alpha = End(self, "alpha", PeerSettings("bravo", KEY_B.public, None, link), egress.get("alpha", _NONE))
        self.bravo = End(self, "bravo", PeerSettings("alpha", KEY_A.public, None, link), egress.get("bravo", _NONE))
        self._rng = random.Random(seed)
        self._arriving: list[tuple[float, int, Callable[[], None]]] = []
        self._number = 0
        self._arrived_at: dict[tuple[End, int], float] = {}  # a radio keeps the order, also when its delay changes
        self.alpha.link.set_paths([self._path_to(number, self.bravo) for number in range(len(radios))], 0.0)

    def transmit(self, sender: End, datagram: bytes, path: Path) -> None:
        """Put a datagram on the air."""
        radio = self.radios[path.socket]
        if self._rng.random() < radio.loss:
            return
        receiver = self.bravo if sender is self.alpha else self.alpha
        source = self._path_to(path.socket, sender)
        delay_s = radio.delay_s + self._rng.uniform(0.0, radio.jitter_s)
        arrives_at = max(self.now + delay_s, self._arrived_at.get((sender, path.socket), 0.0))
        self._arrived_at[sender, path.socket] = arrives_at
        self.at(arrives_at, lambda: receiver.perform(receiver.node.receive(datagram, source, self.now)))

    def _path_to(self, number: int, end: End) -> Path:
        if self.radios[number].is_relayed:
            return relayed(number, "relay", 1 + (end is self.bravo))
        return path_of(number, end.name)

    def at(self, when: float, action: Callable[[], None]) -> None:
        """Do something later."""
        self._number += 1
        heappush(self._arriving, (when, self._number, action))

    def run(self, until: float) -> None:
        """Let time pass."""
        for _ in range(1_000_000):
            ends = self.alpha, self.bravo
            arrival = self._arriving[0][0] if self._arriving else NEVER
            deadline = min(end.next_deadline() for end in ends)
            if min(arrival, deadline) > until:
                self.now = until
                return
            self.now = max(self.now, min(arrival, deadline))
            if arrival <= deadline:
                heappop(self._arriving)[2]()
            else:
                for end in ends:
                    if end.next_deadline() <= self.now:
                        end.handle_timeout(self.now)
        raise AssertionError("deadlines without end")

    def establish(self) -> None:
        """Let time pass until all paths of both ends are usable."""
        for _ in range(1000):
            self.run(self.now + 0.1)
            if all(len(_usable(end)) == len(self.radios) for end in (self.alpha, self.bravo)):
                return
        raise AssertionError([end.peer.paths.states for end in (self.alpha, self.bravo)])


_NONE = EgressSettings()


def path_of(number: int, name: str) -> Path:
    """The address of an end on a radio."""
    return Path(number, (f"192.0.{number}.{len(name)}{'12'[name == 'bravo']}", 14600))


def _usable(end: End) -> list[Path]:
    return [state.path for state in end.peer.paths.states if state.works]
