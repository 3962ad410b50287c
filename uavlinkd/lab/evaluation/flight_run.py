"""``uavlinkd evaluate flight``: two aircraft exchange their positions in flight, with a man in the middle.

One flight, three links at the same time: plain MAVLink, the paper's protocol, and two daemons. Each carries every
position of both aircraft, and each has a man in the middle, who makes the same attacks at the same times. So all
differences between the links come from their protocols.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from contextlib import AsyncExitStack
from functools import partial
from time import monotonic
from typing import Any

from uavlinkd.lab.evaluation.flight_links import DaemonLink, PaperLink, PlainLink
from uavlinkd.lab.evaluation.flight_plan import (
    PAIR,
    POSITION_RATE_HZ,
    SAMPLE_S,
    SYSTEM_IDS,
    AttackPhase,
    FlightSettings,
    Flown,
    LinkKind,
    Origin,
    PositionSample,
    Provenance,
    Receiver,
    samples,
)
from uavlinkd.lab.evaluation.flight_report import FlightFindings, flight_problems, sections, summary
from uavlinkd.lab.evaluation.frame import Evaluation, Work
from uavlinkd.lab.evaluation.records import Record, Value
from uavlinkd.lab.evaluation.stage import until
from uavlinkd.lab.sim.aircraft import Aircraft, AircraftChoice, choice_of
from uavlinkd.lab.sim.autopilot import HOME

_NOTICE_S = 0.25


async def run_flight(work: Work[FlightSettings]) -> dict[str, Any]:
    """Fly, and write the records.

    Raises:
        EvaluationError, PilotError, RealAutopilotError, DroneError: an aircraft or a link failed.
    """
    return await _Run(work).fly(AircraftChoice() if work.settings.quick else choice_of())


class _Run:
    def __init__(self, work: Work[FlightSettings]) -> None:
        self._work = work
        self._settings = work.settings
        self._origin = Origin(HOME.latitude_deg, HOME.longitude_deg)
        self._flown = {name: Flown() for name in PAIR}
        self._sent: dict[str, dict[bytes, float]] = {name: {} for name in PAIR}
        self._receivers = {
            kind: {name: Receiver(self._origin, self._sent[_other(name)]) for name in PAIR} for kind in LinkKind
        }
        self._links: list[PlainLink] = []
        self._began_at = 0.0
        self._phases: list[tuple[AttackPhase, float, float]] = []

    async def fly(self, choice: AircraftChoice) -> dict[str, Any]:
        async with AsyncExitStack() as stack:
            aircraft = {
                name: await stack.enter_async_context(
                    Aircraft(
                        choice,
                        SYSTEM_IDS[name],
                        HOME,
                        self._work.folder / f"aircraft-{name}",
                        partial(self._on_frame, name),
                    )
                )
                for name in PAIR
            }
            self._work.show(f"{aircraft[PAIR[0]].name}: both aircraft take off")
            await asyncio.gather(
                *(one.pilot.take_off(self._settings.altitude_m, POSITION_RATE_HZ) for one in aircraft.values())
            )
            self._began_at = monotonic()
            paths = self._settings.paths()
            following = [asyncio.create_task(aircraft[name].pilot.follow(paths[name])) for name in PAIR]
            attacking = asyncio.create_task(self._exchange_and_attack())
            try:
                done, _ = await asyncio.wait({*following, attacking}, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()  # an aircraft that does not fly on has raised
            finally:
                for task in (*following, attacking):
                    task.cancel()
                await asyncio.gather(*following, attacking, return_exceptions=True)
            self._add_samples()
            return {"aircraft": aircraft[PAIR[0]].name, "duration_s": round(self._now(), 1)}

    def _now(self) -> float:
        return monotonic() - self._began_at

    async def _exchange_and_attack(self) -> None:
        async with AsyncExitStack() as stack:
            await self._open_links(stack)
            watching = asyncio.create_task(self._watch_states())
            stack.callback(watching.cancel)
            for number, (phase, duration_s) in enumerate(self._settings.phases()):
                # The attacker records for the replay during the first phase, which is otherwise quiet. It goes on.
                attack = AttackPhase.REPLAY if number == 0 else phase
                await self._run_phase(phase, None if phase is AttackPhase.REPLAY else attack, duration_s)

    async def _open_links(self, stack: AsyncExitStack) -> None:
        def place(kind: LinkKind) -> tuple[FlightSettings, Any, Any]:
            log = self._work.out / f"mitm-flight-{kind}.jsonl"
            return self._settings, log, lambda name, frame: self._receivers[kind][name].accept(frame, self._now())

        for link in (
            PlainLink(*place(LinkKind.PLAIN)),
            PaperLink(*place(LinkKind.PAPER)),
            DaemonLink(*place(LinkKind.OURS), self._work.folder),
        ):
            stack.push_async_callback(link.close)
            await link.open()
            self._links.append(link)
        for kind in LinkKind:
            await until(partial(self._has_arrived, kind), f"no position arrived over {kind}")

    async def _has_arrived(self, kind: LinkKind) -> bool:
        return all(receiver.beliefs for receiver in self._receivers[kind].values())

    async def _run_phase(self, phase: AttackPhase, attack: AttackPhase | None, duration_s: float) -> None:
        """One phase; ``attack``: what begins with it, None if the attack before goes on."""
        before = [await link.notice() for link in self._links]
        begin_s = self._phases[-1][2] if self._phases else self._now()  # each accepted frame is in a phase
        self._work.show(f"{begin_s:6.1f} s  {phase}")
        if attack is not None:
            for link in self._links:
                await link.attack(attack)
        await asyncio.sleep(max(0.0, begin_s + duration_s - self._now()))
        end_s = self._now()
        self._phases.append((phase, begin_s, end_s))
        for link, notice in zip(self._links, before, strict=True):
            counts = (await link.notice()).counts - notice.counts
            frames = Counter(
                provenance
                for receiver in self._receivers[link.kind].values()
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
            self._work.add(Record("phase", {"link": link.kind.value, "phase": phase.value}, values))

    async def _watch_states(self) -> None:
        """Record what the daemons report of their link, at each change."""
        last = {link.kind: "" for link in self._links}
        while True:
            for link in self._links:
                state = (await link.notice()).state
                if state != last[link.kind]:
                    last[link.kind] = state
                    values = {"at_s": round(self._now(), 3), "state": state}
                    self._work.add(Record("state", {"link": link.kind.value}, values))
            await asyncio.sleep(_NOTICE_S)

    def _on_frame(self, name: str, frame: bytes) -> None:
        place = self._origin.place_in(frame)
        if place is None or not self._began_at:
            return
        now = self._now()
        self._sent[name][frame] = now
        self._flown[name].add(now, place)
        for link in self._links:
            link.send(name, frame)

    def _add_samples(self) -> None:
        for kind, receivers in self._receivers.items():
            for name, receiver in receivers.items():
                sender, before = _other(name), AttackPhase.QUIET
                for phase, begin_s, end_s in self._phases:
                    for sample in samples(self._flown[sender], receiver.beliefs, begin_s, end_s, SAMPLE_S):
                        # An attack has an effect until a position is accepted after its end.
                        is_over = sample.belief.accepted_at >= begin_s
                        cause = before if phase is AttackPhase.QUIET and not is_over else phase
                        point: dict[str, Value] = {"link": kind.value, "aircraft": sender, "phase": cause.value}
                        self._work.add(Record("sample", point, _values(sample)))
                    before = phase


def _values(sample: PositionSample) -> dict[str, Value]:
    return {
        "at_s": round(sample.at, 3),
        "flown_east_m": round(sample.flown.east_m, 2),
        "flown_north_m": round(sample.flown.north_m, 2),
        "believed_east_m": round(sample.belief.place.east_m, 2),
        "believed_north_m": round(sample.belief.place.north_m, 2),
        "error_m": round(sample.error_m, 2),
        "age_s": round(sample.age_s, 3),
        "accepted_at_s": round(sample.belief.accepted_at, 3),
        "provenance": sample.belief.provenance.value,
    }


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
    draw="draw_flight",
)
