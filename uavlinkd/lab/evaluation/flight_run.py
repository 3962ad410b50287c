"""``uavlinkd evaluate flight``: two aircraft exchange their positions in flight, with a man in the middle.

One flight, two links at the same time: the paper's protocol, and two daemons. Each carries every position of both
aircraft, and each has a man in the middle, who makes the same attacks at the same times. So all differences between
the links come from their protocols.
"""

from __future__ import annotations

import asyncio
import struct
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import AsyncExitStack
from functools import partial
from random import Random
from time import monotonic
from typing import Any

from uavlinkd.lab.evaluation.flight_plan import (
    ALTERED_SHARE,
    GLOBAL_POSITION_INT,
    PAIR,
    POSITION_RATE_HZ,
    SYSTEM_IDS,
    AttackPhase,
    DisplacePositions,
    Drift,
    FlightSettings,
    LinkKind,
    Origin,
    Place,
    Provenance,
    Receiver,
)
from uavlinkd.lab.evaluation.flight_report import FlightFindings, flight_problems, sections, summary
from uavlinkd.lab.evaluation.frame import Evaluation, Work
from uavlinkd.lab.evaluation.middle import MiddleHere
from uavlinkd.lab.evaluation.paper_attacks import PaperRelay
from uavlinkd.lab.evaluation.records import Record
from uavlinkd.lab.evaluation.stage import DaemonStage, PaperStage, Stage, until
from uavlinkd.lab.mitm.anatomy import mavlink_frame
from uavlinkd.lab.mitm.attack import AttackObject
from uavlinkd.lab.sim.vehicle import Axes, GeoPoint, Mode, Vehicle
from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.frames import SplitCounters, split_datagram

HOME = GeoPoint(47.397742, 8.545594, 488.0)
_NEAR_M = 8.0
"""At this distance from a point of its path, an aircraft turns to the next one, so that it does not stop."""
_NOTICE_S = 0.25
_POSITION = struct.Struct("<IiiiihhhH")


class FlyingCopter:
    """A simulated copter that flies along points, round after round. It has already taken off."""

    def __init__(self, system_id: int, path: Sequence[Axes]) -> None:
        self._system_id = system_id
        self._path = list(path)
        self._vehicle = Vehicle(HOME)
        self._vehicle.arm()
        self._vehicle.set_mode(Mode.GUIDED)
        self._vehicle.take_off(path[0].up)
        while not self._vehicle.has_arrived():
            self._vehicle.step(1 / POSITION_RATE_HZ)
        self._sent = 0

    def fly(self, duration_s: float) -> bytes:
        """Fly for so long, and return the position there as a frame."""
        vehicle = self._vehicle
        if vehicle.has_arrived(_NEAR_M) or not self._sent:
            self._path.append(self._path.pop(0))
            vehicle.go_to(self._path[-1])
        vehicle.step(duration_s)
        place, speed = vehicle.place, vehicle.velocity
        payload = _POSITION.pack(
            round(1000 * self._sent / POSITION_RATE_HZ),
            *(round(1e7 * place.latitude_deg), round(1e7 * place.longitude_deg)),
            *(round(1000 * place.altitude_m), round(1000 * vehicle.altitude_m)),
            *(round(100 * speed.north), round(100 * speed.east), round(-100 * speed.up), 0),
        )
        self._sent += 1
        crc_extra = MESSAGES[GLOBAL_POSITION_INT][1]
        return mavlink_frame(GLOBAL_POSITION_INT, payload, crc_extra, self._system_id, self._sent)


class _SwarmStage(DaemonStage):
    """Two daemons of a swarm, which exchange keys again and again."""

    def rules(self, one: str, other: str) -> dict[str, object]:
        del one
        return {"role": "swarm-member", "system_ids": [SYSTEM_IDS[other]]}

    def state(self) -> str:
        """What a daemon reports of the link: the worse of both, empty if nothing is wrong."""
        peers = [peer for drone in self.drones.values() for peer in drone.peer_statuses]
        if any(peer["state"] != "up" for peer in peers):
            return "link down"
        return "freshness unverified" if any(peer["freshness_unverified_s"] is not None for peer in peers) else ""


async def run_flight(work: Work[FlightSettings]) -> dict[str, Any]:
    """Fly, and write the records.

    Raises:
        EvaluationError, DroneError: a link failed.
    """
    return await _Run(work).fly()


class _Run:
    def __init__(self, work: Work[FlightSettings]) -> None:
        self._work = work
        self._settings = work.settings
        self._origin = Origin(HOME.latitude_deg, HOME.longitude_deg)
        self._flown: dict[str, list[tuple[float, Place]]] = {name: [] for name in PAIR}
        self._sent: dict[str, dict[bytes, float]] = {name: {} for name in PAIR}
        self._receivers = {
            kind: {name: Receiver(self._origin, self._sent[_other(name)]) for name in PAIR} for kind in LinkKind
        }
        link = {"rekey_after_s": self._settings.rekey_after_s}
        self._middles = {kind: MiddleHere(PAIR, self._settings.seed) for kind in LinkKind}
        self._paper = PaperStage(PAIR, self._middles[LinkKind.PAPER], rate_hz=0.0, renew_s=None)
        self._ours = _SwarmStage(PAIR, work.folder, self._middles[LinkKind.OURS], link, rate_hz=0.0)
        self._stages: dict[LinkKind, Stage] = {LinkKind.PAPER: self._paper, LinkKind.OURS: self._ours}
        for kind, stage in self._stages.items():
            stage.receive = partial(self._on_received, kind)
        self._is_relayed = False
        self._began_at = monotonic()
        self._phases: list[tuple[AttackPhase, float, float]] = []

    def _on_received(self, kind: LinkKind, name: str, datagram: bytes, now: float) -> None:
        for frame in split_datagram(datagram, SplitCounters()):
            self._receivers[kind][name].accept(frame.raw, now - self._began_at)

    async def fly(self) -> dict[str, Any]:
        async with AsyncExitStack() as stack:
            for stage in self._stages.values():
                stack.push_async_callback(stage.close)
                await stage.open()
            self._began_at = monotonic()
            for work in (self._fly_on(), self._watch_state()):
                stack.callback(asyncio.create_task(work).cancel)
            for kind in LinkKind:
                await until(partial(self._has_arrived, kind), f"no position arrived over {kind}")
            for number, (phase, duration_s) in enumerate(self._settings.phases()):
                # The attacker records for the replay during the first phase, which is otherwise quiet. It goes on.
                attack = AttackPhase.REPLAY if number == 0 else phase
                await self._run_phase(phase, None if phase is AttackPhase.REPLAY else attack, duration_s)
            duration_s = self._now()
        self._add_errors()
        return {"duration_s": round(duration_s, 1)}

    def _now(self) -> float:
        return monotonic() - self._began_at

    async def _has_arrived(self, kind: LinkKind) -> bool:
        return all(receiver.beliefs for receiver in self._receivers[kind].values())

    async def _fly_on(self) -> None:
        copters = {name: FlyingCopter(SYSTEM_IDS[name], path) for name, path in self._settings.paths().items()}
        flown_s = due_s = 0.0
        while True:
            now = self._now()
            for name, copter in copters.items():
                frame = copter.fly(now - flown_s)
                place = self._origin.place_in(frame)
                assert place is not None
                self._sent[name][frame] = now
                self._flown[name].append((now, place))
                for stage in self._stages.values():
                    stage.send(name, frame)
            flown_s = now
            due_s = max(due_s + 1 / POSITION_RATE_HZ, now)  # at a fixed pace: a replay comes just after a position
            await asyncio.sleep(due_s - now)

    async def _run_phase(self, phase: AttackPhase, attack: AttackPhase | None, duration_s: float) -> None:
        """One phase; ``attack``: what begins with it, None if the attack before goes on."""
        before = {kind: await stage.notices() for kind, stage in self._stages.items()}
        begin_s = self._phases[-1][2] if self._phases else self._now()  # each accepted frame is in a phase
        self._work.show(f"{begin_s:6.1f} s  {phase}")
        if attack is not None:
            for kind in LinkKind:
                await self._attack(kind, attack)
        await asyncio.sleep(max(0.0, begin_s + duration_s - self._now()))
        end_s = self._now()
        self._phases.append((phase, begin_s, end_s))
        for kind, stage in self._stages.items():
            counts = sum((await stage.notices()).values(), Counter[str]())
            counts -= sum(before[kind].values(), Counter[str]())
            frames = Counter(
                provenance
                for receiver in self._receivers[kind].values()
                for at, provenance in receiver.frames
                if begin_s <= at < end_s
            )
            values = {
                "begin_s": round(begin_s, 3),
                "end_s": round(end_s, 3),
                "sent": sum(begin_s <= at < end_s for sent in self._sent.values() for at in sent.values()),
                **{provenance.value: frames[provenance] for provenance in Provenance},
                "noticed": ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items())),
            }
            self._work.add(Record("phase", {"link": kind.value, "phase": phase.value}, values))

    async def _attack(self, kind: LinkKind, phase: AttackPhase) -> None:
        """Begin a phase. The attacks of the phase before end; what they hold is lost."""
        settings, is_paper = self._settings, kind is LinkKind.PAPER
        specs = {
            AttackPhase.REPLAY: [f"duplicate,when=later,delay_s={settings.replay_delay_s:g}"],
            AttackPhase.HOLD: [f"hold,kinds=any,hold_s={settings.hold_s:g}"],
            AttackPhase.DROP: ["drop"],
            AttackPhase.KEYS: [] if is_paper else ["replace-key"],
        }
        middle, objects = self._middles[kind], list[AttackObject]()
        if phase is AttackPhase.KEYS and is_paper:
            objects.append(PaperRelay(Drift().move))
        elif phase in (AttackPhase.ALTER, AttackPhase.KEYS):
            half = DisplacePositions.options_model.model_validate({"share": ALTERED_SHARE})
            rng = Random(f"displace {settings.seed}")  # noqa: S311  not a secret
            objects.append(DisplacePositions(half, middle.context, rng, monotonic()))
        await middle.attack(specs.get(phase, []), objects)
        if is_paper and (self._is_relayed or phase is AttackPhase.KEYS):
            # With the attacker between both ends; after that, without: otherwise no frame would be accepted any more.
            self._is_relayed = phase is AttackPhase.KEYS
            self._paper.ends[PAIR[0]].renew()

    async def _watch_state(self) -> None:
        """Record what the daemons report of their link, at each change."""
        last = ""
        while True:
            await self._ours.notices()
            state = self._ours.state()
            if state != last:
                last = state
                self._work.add(Record("state", {}, {"at_s": round(self._now(), 3), "state": state}))
            await asyncio.sleep(_NOTICE_S)

    def _add_errors(self) -> None:
        """What the receivers believed each time an aircraft sent its position, by phase: error and age."""
        for kind, receivers in self._receivers.items():
            errors_m, ages_s = (
                defaultdict[AttackPhase, list[float]](list),
                defaultdict[AttackPhase, list[float]](list),
            )
            for name, receiver in receivers.items():
                before = AttackPhase.QUIET
                for phase, begin_s, end_s in self._phases:
                    for at, place in self._flown[_other(name)]:
                        belief = receiver.belief_at(at) if begin_s <= at < end_s else None
                        if belief is None:
                            continue
                        # An attack has an effect until a position is accepted after its end.
                        is_over = belief.accepted_at >= begin_s
                        cause = before if phase is AttackPhase.QUIET and not is_over else phase
                        errors_m[cause].append(round(place.distance_m(belief.place), 2))
                        ages_s[cause].append(round(at - belief.sent_at, 3))
                    before = phase
            for phase in errors_m:
                values = {"errors_m": errors_m[phase], "ages_s": ages_s[phase]}
                self._work.add(Record("believed", {"link": kind.value, "phase": phase.value}, values))


def _other(name: str) -> str:
    (other,) = set(PAIR) - {name}
    return other


FLIGHT = Evaluation(
    name="flight",
    title="Two aircraft exchange positions in flight under attack",
    settings=FlightSettings,
    run=run_flight,
    findings=FlightFindings,
    sections=sections,
    problems=flight_problems,
    summary=summary,
)
