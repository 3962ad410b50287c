"""Attacks on a pair with two paths: no critical frame is lost, and the link stays up while one path works.

The simulated network checks at every delivery that the frame was sent, is unaltered, and is delivered once.
"""

from __future__ import annotations

from collections import Counter

import pytest

from tests.lab.mitm.middle import Middle
from tests.network.network import Drone, Flow, Network
from uavlinkd.lab.mitm.attack import Attack
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.constants import LATE_AFTER_S
from uavlinkd.protocol.outputs import PathChanged, PeerLost
from uavlinkd.protocol.settings import Class, Link

SLOWER = RadioSettings(delay_s=0.02)
"""The second path, in each direction, beyond the delay of the first one."""
STREAM_S, CRITICAL_S = 0.02, 0.1
SETTLE_S = 6.0


class TwoPaths:
    """A linked pair. The first path is the faster one.

    ``learns``: b has no address of a, so that its paths are learned ones.
    """

    def __init__(self, name: str, *, learns: bool, starts: bool = True) -> None:
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
        self.stream = self._flows(Class.STREAM, STREAM_S)
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

    def attack(self, line: str, seconds: float) -> list[Attack]:
        """Attack for some seconds, as the line for the man in the middle says."""
        self.begun_at, self._before = self.network.now, self.drops
        made = [
            parse_attack(f"{text},seconds={seconds}").make(self.middle.context, position, self.begun_at)
            for position, text in enumerate(line.split())
        ]
        self.middle.attack(*made)
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


pytestmark = pytest.mark.long

LASTING_S = 14.0
"""Longer than a path that is down still gets copies."""

# The line of attacks, and what must be counted. "path_changed" is an event.
ATTACKS: dict[str, tuple[str, set[str]]] = {
    "copies at once": ("replay-data,direction=both/1,onto=2", {"duplicate"}),
    "copies after 3 s": ("replay-data,direction=both/1,onto=2,when=later,delay_s=3", {"late_copy"}),
    "copies after 10 s": ("replay-data,direction=both/1,onto=2,when=later,delay_s=10", {"late_copy"}),
    "moved": ("move,direction=both/1,onto=2", {"unexpected_answer"}),
    "dropped": ("drop,direction=both/1", {"path_changed"}),
    "slowed": ("hold,kinds=any,direction=both/1,hold_s=0.2", {"path_changed"}),
    "the other one slowed": ("hold,kinds=any,direction=both/2,hold_s=0.2", {"duplicate"}),
    "frames dropped": ("drop,kinds=frames,direction=both/1", {"path_changed"}),
    "frames delayed": ("hold,kinds=frames,direction=both/1,hold_s=3", {"path_changed", "delayed"}),
    "frames replaced": (
        "drop,kinds=frames,direction=both/1 move,direction=both/2,onto=1,beside=true",
        {"unexpected_answer"},
    ),
    "held": ("hold,kinds=any,direction=both/1,hold_s=10,at_once=true", {"path_changed", "late_copy", "delayed"}),
    "probes copied": ("duplicate,kinds=probe,direction=both/1,onto=2", {"duplicate"}),
    "probes faster along the other": ("move,kinds=probe,direction=both/2,onto=1,beside=true", {"unexpected_answer"}),
    "probes later": ("duplicate,kinds=probe,direction=both/1,when=later,delay_s=1", {"duplicate"}),
    "probes altered": ("bit-flip,kinds=probe,direction=both/1", {"bad_tag", "path_changed"}),
    "racing": ("roam,direction=both/1", {"duplicate", "paths_unproven"}),
    "from elsewhere": ("roam,direction=both/1,mode=instead", {"paths_unproven"}),
    "relayed": ("roam,direction=both/1,mode=relay", {"path_changed"}),
    "spoofed sources": ("wander,mode=race", {"paths_unproven"}),
    "relayed sources": ("wander,direction=both/1", {"paths_unproven"}),
}
RELAYS = {"relayed", "relayed sources"}
"""Their strangers become validated addresses."""


@pytest.mark.parametrize("learns", [False, True], ids=["configured", "learned"])
@pytest.mark.parametrize("name", ATTACKS)
def test_no_critical_frame_is_lost_while_one_path_works(name: str, learns: bool) -> None:
    """For 14 s; then both sides come back to the faster path within seconds."""
    line, counts = ATTACKS[name]
    pair = TwoPaths(name, learns=learns)
    assert pair.numbers_of_best() == {1}
    made = pair.attack(line, LASTING_S)
    assert made[0].attempts > 0
    pair.network.run(4.0)

    assert pair.lost(pair.critical) == 0
    assert pair.longest_gap_s(pair.critical) < 1.5 * CRITICAL_S + 0.2
    assert pair.stayed_up
    seen = {*pair.counted, *(["path_changed"] if pair.changes() else [])}
    assert counts <= seen
    assert max(flow.oldest_s for flow in (*pair.stream, *pair.critical)) < LATE_AFTER_S + 0.75
    if name not in RELAYS:
        assert pair.amplified() == []
    assert all(flow.first_delivery(pair.ended_at) - pair.ended_at < 1.0 for flow in pair.stream)


@pytest.mark.parametrize("learns", [False, True], ids=["configured", "learned"])
def test_responses_dropped_on_the_fastest_path_do_not_prevent_a_session(learns: bool) -> None:
    """From the first initiation on: the response along the other path makes the session."""
    pair = TwoPaths("responses", learns=learns, starts=False)
    pair.a.start()
    pair.b.start()
    (attack,) = pair.attack("drop-message,message=response,direction=both/1", 5.0)
    assert attack.attempts > 0
    assert all(flow.first_delivery(0.0) < 1.0 for flow in pair.stream)
