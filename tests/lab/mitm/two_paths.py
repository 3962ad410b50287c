"""Two nodes with two paths between them, the man in the middle on both, and frames of two classes."""

from __future__ import annotations

from collections import Counter

from tests.lab.mitm.middle import Middle
from tests.network.network import Drone, Flow, Network
from uavlinkd.core.outputs import PathChanged, PeerLost
from uavlinkd.core.settings import Class, Link
from uavlinkd.lab.mitm.attack import Attack, AttackObject
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.radio import RadioSettings

SLOWER = RadioSettings(delay_s=0.02)
"""The second path, in each direction, beyond the delay of the first one."""
STREAM_S, CRITICAL_S = 0.02, 0.1
SETTLE_S = 6.0


class TwoPaths:
    """A linked pair. The first path is the faster one.

    ``learns``: b has no address of a, so that its paths are learned ones. ``streams``: there are other frames than
    critical ones.
    """

    def __init__(self, name: str, *, learns: bool = False, starts: bool = True, streams: bool = True) -> None:
        self.network = Network(f"two paths {name}", RadioSettings(delay_s=0.01))
        self.network.checks_bounds = False
        self.a, self.b = self.network.add("a"), self.network.add("b")
        self.middle = Middle(self.network, self.a, self.b, paths=2)
        context = self.middle.context
        radios = {direction: SLOWER for direction in context.directions if direction.path == 2}
        self.middle.channel = AttackChannel(context, radios=radios)
        self.middle.introduce(Link())
        if learns:
            self.b.acquaintances["a"] = self.b.acquaintances["a"][0], ()
        self.stream = self._flows(Class.STREAM, STREAM_S) if streams else ()
        self.critical = self._flows(Class.CRITICAL, CRITICAL_S)
        self.begun_at = self.ended_at = 0.0
        self._before: Counter[str] = Counter()
        if starts:
            self.start()

    def start(self) -> None:
        """Start both, and let them choose the best path."""
        self.a.start()
        self.b.start()
        self.network.run(SETTLE_S)

    def attack(self, line: str, seconds: float, *others: AttackObject, spoils_s: float = 0.0) -> list[Attack]:
        """Attack for some seconds, as the line for the man in the middle says. What ``spoils_s`` before loses is not
        counted.
        """
        now = self.network.now
        made = [
            parse_attack(text if "seconds=" in text else f"{text},seconds={seconds}").make(
                self.middle.context, position, now
            )
            for position, text in enumerate(line.split())
        ]
        self._before = self.drops
        self.middle.attack(*made, *others)
        self.network.run(spoils_s)
        self.begun_at = self.network.now
        self.network.run(seconds)
        self.ended_at = self.network.now
        return made

    @property
    def drops(self) -> Counter[str]:
        counts: Counter[str] = Counter()
        for drone, other in self._ends():
            counts.update(drone.peer(other).traffic.drops)
            counts["paths_unproven"] += drone.peer(other).paths.unproven
        return counts

    @property
    def counted(self) -> Counter[str]:
        """What both have counted since the attack began."""
        return self.drops - self._before

    def lost(self, flows: tuple[Flow, ...]) -> int:
        """How many frames that were sent during the attack were never delivered."""
        return sum(len(flow.lost(self.begun_at, self.ended_at)) for flow in flows)

    def longest_gap_s(self, flows: tuple[Flow, Flow]) -> float:
        """The longest silence during the attack, in either direction."""
        return max(flow.longest_gap(self.begun_at, self.ended_at) for flow in flows)

    def changes(self) -> list[str]:
        """Why the best paths changed since the attack began."""
        return [
            output.reason
            for drone in (self.a, self.b)
            for at, output in drone.outputs
            if isinstance(output, PathChanged) and at >= self.begun_at
        ]

    @property
    def stayed_up(self) -> bool:
        """Whether no side lost the other since the attack began."""
        return not any(
            isinstance(output, PeerLost) and at >= self.begun_at
            for drone in (self.a, self.b)
            for at, output in drone.outputs
        )

    def numbers_of_best(self) -> set[int]:
        """The paths that both sides prefer; 0 for an address of the attacker."""
        context, numbers = self.middle.context, set()
        for drone, other in self._ends():
            best = drone.peer(other).path
            assert best is not None
            numbers.add(
                next(
                    (
                        direction.path
                        for direction in context.directions
                        if self.middle.listener(*direction) == best.address and direction.sender == drone.name
                    ),
                    0,
                )
            )
        return numbers

    def amplified(self) -> list[tuple[str, int]]:
        """The strangers that received more than they sent."""
        return list(self.middle.amplification.excess)

    def _ends(self) -> tuple[tuple[Drone, Drone], ...]:
        return (self.a, self.b), (self.b, self.a)

    def _flows(self, cls: Class, interval_s: float) -> tuple[Flow, Flow]:
        network = self.network
        return (
            network.traffic(self.a, self.b, interval_s, cls=cls),
            network.traffic(self.b, self.a, interval_s, cls=cls),
        )
