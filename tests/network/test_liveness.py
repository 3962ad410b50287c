"""From the moment one path is honest, every frame that must be new arrives soon, whatever happens to the others.

A history has a vehicle and a station with two or three paths. An attacker drops, holds, delays, replays and copies
datagrams on each of them; ends restart, networks and addresses change, keys too. Then one path is honest, and the
attacker goes on with the others. Every critical frame from then on must arrive within :data:`WITHIN_S`: section 15 of
the specification. Planted faults are found.
"""

from __future__ import annotations

import os
import traceback
from collections import Counter
from dataclasses import dataclass, field
from random import Random

import pytest

from tests.network.air import Hop
from tests.network.attackers import Recorder
from tests.network.drone import share_a_session
from tests.network.network import Network, every_second_may_be_old
from tests.network.vehicle import add_vehicle, hop
from tests.protocol.plants import LIVENESS_FAULTS
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import Class, Link, Redundancy, Timers

WITHIN_S = 0.5
"""A frame that is sent while one path is honest arrives within this time."""
LONGEST_DELAY_S = 0.098
KNOWN_WITHIN_S = 11.0
"""Ends share a session, and have both validated the honest path. After a restart of a station that has no address of
the vehicle, the vehicle notices it after `HANDSHAKE_ROUND_TRIPS` of a path that was slowed to `LATE_AFTER_S`."""
JUDGED_S = 2.0
"""For so long frames are sent that must arrive."""
_WAYS = ("", " there", " back")
ACTS = (
    *(act + way for act in ("drop", "hold", "delay", "lose", "disorder") for way in _WAYS),
    *("leave alone", "replay", "copy", "copy", "move", "lose network", "find network"),
)
"""What may happen to a path. A way names the direction from the vehicle to the station, or back."""
_RECORDED = 400


@dataclass
class Outcome:
    """What histories showed."""

    histories: int = 0
    judged: int = 0
    """Critical frames that had to arrive."""
    by_paths: Counter[int] = field(default_factory=Counter)
    acts: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    """The greatest age of such a frame when it arrived."""
    known_s: float = 0.0
    """The longest time until both ends had a session and the path."""
    violations: list[tuple[int, str]] = field(default_factory=list)

    def add(self, other: Outcome) -> None:
        self.histories += other.histories
        self.judged += other.judged
        self.by_paths += other.by_paths
        self.acts += other.acts
        self.slowest_s = max(self.slowest_s, other.slowest_s)
        self.known_s = max(self.known_s, other.known_s)
        self.violations += other.violations


def play(seed: int) -> Outcome:
    """Play one history. What did not hold is in :attr:`Outcome.violations`."""
    history = _History(seed)
    try:
        with history.network:
            history.play()
    except Exception as error:  # whatever it is: no history may raise
        history.outcome.violations.append((seed, "".join(traceback.format_exception(error))))
    return history.outcome


class _History:
    def __init__(self, seed: int) -> None:
        self.lot = lot = Random(f"liveness {seed}")
        self.network = Network(f"liveness {seed}", RadioSettings())
        if lot.random() < 0.5:
            self.network.screen = every_second_may_be_old
        paths = lot.choice((2, 2, 3))
        self.outcome = Outcome(histories=1, by_paths=Counter([paths]))
        link = Link(
            timers=Timers(rekey_after_s=lot.choice((1.0, 3.0, 120.0))),
            confidential=lot.random() < 0.2,
            redundancy=lot.choice((Redundancy.CRITICAL, Redundancy.CRITICAL, Redundancy.ALL)),
        )
        radios = [self._honest() for _ in range(paths)]
        self.vehicle, self.station = add_vehicle(self.network, radios, link, is_known=lot.random() < 0.5)
        self.vehicle.metered_sockets = {number for number in range(paths) if lot.random() < 0.2}
        self.hops = [hop(self.vehicle, self.station, number) for number in range(paths)]
        self.recorder = Recorder(self.network, keep=_RECORDED)

    def play(self) -> None:
        """A quiet time, attacks, and the judgement."""
        network, lot, ends = self.network, self.lot, (self.vehicle, self.station)
        for drone in ends:
            drone.start()
        for sender, receiver in (ends, ends[::-1]):
            network.traffic(sender, receiver, lot.choice((0.04, 0.1, 0.4)), cls=Class.CRITICAL)
        if lot.random() < 0.3:
            network.talk(*ends, lot.choice((0.02, 0.2)))
        network.run(lot.choice((0.0, 1.0, 4.0)))
        for _ in range(lot.randint(1, 4)):
            for one in self.hops:
                self._befall(one)
            if lot.random() < 0.15:
                self.outcome.acts["restart"] += 1
                lot.choice(ends).start()
            network.run(lot.choice((0.3, 1.0, 2.5, lot.uniform(3.0, 8.0))))
        self._judge(lot.choice(self.hops))

    def _judge(self, honest: Hop) -> None:
        network, others = self.network, [one for one in self.hops if one != honest]
        for one in others:
            self._befall(one)
        self._restore(honest)
        self.vehicle.find_network(honest.sender.socket)
        network.note(f"{honest} is honest")
        self.outcome.known_s = network.run_until(lambda: self._is_known(honest), KNOWN_WITHIN_S)
        begin = network.now
        for _ in range(4):
            network.run(JUDGED_S / 4)
            for one in others:
                if self.lot.random() < 0.3:
                    self._befall(one)
        end = network.now
        network.run(WITHIN_S)
        if not self.outcome.acts["restart"]:  # a restart forgets its counts
            for sender, receiver in ((self.vehicle, self.station), (self.station, self.vehicle)):
                overtaken = network.sequence(sender, receiver).overtaken
                assert overtaken <= receiver.peer(sender).traffic.out_of_order, (
                    "frames were overtaken, and not counted"
                )
        for flow in (flow for flow in network.flows.values() if flow.cls is Class.CRITICAL):
            for number, sent_at in enumerate(flow.sent_at):
                if begin <= sent_at < end:
                    age_s = flow.delivered.get(number, float("inf")) - sent_at
                    self.outcome.judged += 1
                    self.outcome.slowest_s = max(self.outcome.slowest_s, age_s)
                    assert age_s <= WITHIN_S, f"{flow.sender} sent frame {number} at {sent_at:.3f}: {age_s:.3f} s"

    def _is_known(self, honest: Hop) -> bool:
        """Whether both ends have one session, and the path has answered at both."""
        vehicle, station, socket = self.vehicle, self.station, honest.sender.socket
        states = (
            vehicle.peer(station).paths.find(Path(socket, station.addresses[0])),
            station.peer(vehicle).paths.find(Path(0, vehicle.addresses[socket])),
        )
        is_validated = all(state is not None and state.is_validated for state in states)
        return is_validated and share_a_session(vehicle, station)

    # What happens to paths.

    def _honest(self) -> RadioSettings:
        return RadioSettings(delay_s=self.lot.choice((0.001, 0.02, self.lot.uniform(0.001, LONGEST_DELAY_S))))

    def _restore(self, one: Hop) -> None:
        """The path is honest from now on. What was held there is delivered at once, or lost."""
        network = self.network
        network.heal_path(one)
        if self.lot.random() < 0.5:
            network.release_path(one)
        else:
            for way in (one, one.back):
                network.air.release(way, network.now)
        network.set_path(one, self._honest())

    def _befall(self, one: Hop) -> None:
        network, lot, socket = self.network, self.lot, one.sender.socket
        act = lot.choice(ACTS)
        self.outcome.acts[act] += 1
        network.note(f"{act}: {one}")
        match act:
            case "replay" | "copy":
                self._inject(one, is_copy=act == "copy")
            case "move":
                self.vehicle.move_socket(socket, (f"10.{socket}.1.{lot.randrange(250)}", lot.randrange(1024, 65536)))
            case "lose network":
                self.vehicle.lose_network(socket)
            case "find network":
                self.vehicle.find_network(socket)
            case _:
                self._restore(one)
                what, _, way = act.partition(" ")
                for direction in {"there": (one,), "back": (one.back,)}.get(way, (one, one.back)):
                    self._spoil(what, direction)

    def _spoil(self, what: str, way: Hop) -> None:
        """Have something happen to one direction of a path from now on."""
        air, lot, now = self.network.air, self.lot, self.network.now
        match what:
            case "drop":
                air.cut(way, now)
            case "hold":
                air.stall(way, now)
            case "delay":
                air.set_hop(way, RadioSettings(delay_s=lot.choice((0.3, 0.9, 1.9, lot.uniform(0.0, 4.0)))), now)
            case "lose":
                air.set_hop(way, RadioSettings(loss=lot.choice((0.2, 0.5, 0.9)), delay_s=0.01), now)
            case "disorder":
                settings = RadioSettings(duplication=0.3, delay_s=0.01, jitter_s=lot.choice((0.1, 1.0)))
                air.set_hop(way, settings, now)

    def _inject(self, one: Hop, *, is_copy: bool) -> None:
        """Send recorded datagrams again: where they were, or, as copies, along this path."""
        recorded, there = self.recorder.recorded, self.vehicle.addresses[one.sender.socket]
        ends = there, self.station.addresses[0]
        for datagram, source, destination in self.lot.sample(recorded, min(40, len(recorded))):
            is_forth = destination == ends[1]
            along = (ends if is_forth else ends[::-1]) if is_copy else (source, destination)
            self.network.inject(datagram, *along)


HISTORIES = int(os.environ.get("UAVLINKD_LIVENESS_HISTORIES", "120"))


@pytest.mark.parametrize("batch", [range(8), pytest.param(range(1000, 1000 + HISTORIES), marks=pytest.mark.long)])
def test_one_honest_path_delivers_every_critical_frame_in_time(batch: range) -> None:
    """After any history, and whatever happens to the other paths."""
    total = Outcome()
    for seed in batch:
        outcome = play(seed)
        assert not outcome.violations, f"seed {seed}: {outcome.violations[0][1]}"
        total.add(outcome)
    print(total)
    assert total.judged > 20 * len(batch)


@pytest.mark.long
@pytest.mark.parametrize("fault", LIVENESS_FAULTS)
def test_a_planted_fault_is_found(monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    """Within some hundred histories."""
    monkeypatch.setattr(*LIVENESS_FAULTS[fault])
    assert any(play(seed).violations for seed in range(1000))
