"""``uavlinkd evaluate flight``: two aircraft exchange their positions in flight, with a man in the middle.

One flight, three links at the same time: plain MAVLink, the paper's protocol, and two daemons. Each carries every
position of both aircraft, and each has a man in the middle, who makes the same attacks at the same times. So all
differences between the links come from their protocols.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from contextlib import AsyncExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic

from uavlinkd.lab.child_processes import private_folder
from uavlinkd.lab.evaluation.flight_links import DaemonLink, LinkNotice, PaperLink, PlainLink, PositionLink
from uavlinkd.lab.evaluation.flight_plan import (
    NAME,
    PAIR,
    POSITION_RATE_HZ,
    SAMPLE_S,
    SYSTEM_IDS,
    AttackPhase,
    FlightSettings,
    LinkKind,
)
from uavlinkd.lab.evaluation.flight_positions import (
    Flown,
    Origin,
    Provenance,
    Receiver,
    samples,
)
from uavlinkd.lab.evaluation.machine import load, machine_facts
from uavlinkd.lab.evaluation.records import Record, RecordWriter, Value
from uavlinkd.lab.sim.aircraft import Aircraft, AircraftChoice
from uavlinkd.lab.sim.autopilot import HOME

LINK_UP_S = 120.0
"""How long the links may take; 1 s on a quiet machine."""
_LOOK_S = 0.02
_NOTICE_S = 0.25

Show = Callable[[str], None]


class FlightError(Exception):
    """The flight failed. The message is for the operator."""


class FlightEvaluation:
    """One run, with its records in ``out``."""

    def __init__(self, out: Path, settings: FlightSettings, choice: AircraftChoice, show: Show) -> None:
        self.out = out
        self.settings = settings
        self._choice = choice
        self._show = show
        self._origin = Origin(HOME.latitude_deg, HOME.longitude_deg)
        self._flown = {name: Flown() for name in PAIR}
        self._sent: dict[str, dict[bytes, float]] = {name: {} for name in PAIR}
        self._receivers: dict[LinkKind, dict[str, Receiver]] = {
            kind: {name: Receiver(self._origin, self._sent[_other(name)]) for name in PAIR} for kind in LinkKind
        }
        self._links: list[PositionLink] = []
        self._began_at = 0.0
        self._phases: list[tuple[AttackPhase, float, float]] = []

    async def run(self) -> None:
        """Fly, and write the records.

        Raises:
            FlightError, PilotError, RealAutopilotError, DroneError: an aircraft or a link failed.
            OSError: the results cannot be written.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        facts = {**machine_facts(), **asdict(self.settings), "began": datetime.now(UTC).isoformat()}
        with private_folder("uavlinkd-") as folder:
            async with AsyncExitStack() as stack:
                aircraft = {
                    name: await stack.enter_async_context(self._aircraft(name, folder / f"aircraft-{name}"))
                    for name in PAIR
                }
                self._show(f"{aircraft[PAIR[0]].name}: both aircraft take off")
                await asyncio.gather(*(self._take_off(one) for one in aircraft.values()))
                self._began_at = monotonic()
                facts["aircraft"] = aircraft[PAIR[0]].name
                with RecordWriter(self.out, NAME, facts) as writer:
                    async with AsyncExitStack() as links:
                        await self._fly(aircraft, links, folder, writer)
                    for record in self._samples():
                        writer.add(record)
                    duration_s = round(self._now(), 1)
                    writer.add(Record("end", {}, {"duration_s": duration_s, "load_after": load()}))

    def _aircraft(self, name: str, folder: Path) -> Aircraft:
        def on_frame(frame: bytes) -> None:
            self._on_frame(name, frame)

        return Aircraft(self._choice, SYSTEM_IDS[name], HOME, folder, on_frame)

    async def _take_off(self, aircraft: Aircraft) -> None:
        await aircraft.pilot.take_off(self.settings.altitude_m, POSITION_RATE_HZ)

    def _now(self) -> float:
        """Seconds since both aircraft have taken off."""
        return monotonic() - self._began_at

    async def _fly(
        self, aircraft: dict[str, Aircraft], stack: AsyncExitStack, folder: Path, writer: RecordWriter
    ) -> None:
        paths = self.settings.paths()
        following = [asyncio.create_task(aircraft[name].pilot.follow(paths[name])) for name in PAIR]
        attacking = asyncio.create_task(self._exchange_and_attack(stack, folder, writer))
        try:
            done, _ = await asyncio.wait({*following, attacking}, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()  # an aircraft that does not fly on has raised
        finally:
            for task in (*following, attacking):
                task.cancel()
            await asyncio.gather(*following, attacking, return_exceptions=True)

    async def _exchange_and_attack(self, stack: AsyncExitStack, folder: Path, writer: RecordWriter) -> None:
        await self._open_links(stack, folder)
        for link in self._links:
            writer.add(self._exchange(link))
        noticing = asyncio.create_task(self._watch_states(writer))
        try:
            for number, (phase, duration_s) in enumerate(self.settings.phases()):
                # The attacker records for the replay during the first phase, which is otherwise quiet.
                attack = AttackPhase.REPLAY if number == 0 else phase
                await self._run_phase(phase, attack, duration_s, writer)
        finally:
            noticing.cancel()
            await asyncio.gather(noticing, return_exceptions=True)

    async def _open_links(self, stack: AsyncExitStack, folder: Path) -> None:
        def log(kind: LinkKind) -> Path:
            return self.out / f"mitm-{NAME}-{kind}.jsonl"

        def deliver(kind: LinkKind) -> Callable[[str, bytes], None]:
            return lambda name, frame: self._receivers[kind][name].accept(frame, self._now())

        settings = self.settings
        links: tuple[PositionLink, ...] = (
            PlainLink(settings, log(LinkKind.PLAIN), deliver(LinkKind.PLAIN)),
            PaperLink(settings, log(LinkKind.PAPER), deliver(LinkKind.PAPER)),
            DaemonLink(settings, log(LinkKind.OURS), deliver(LinkKind.OURS), folder),
        )
        for link in links:
            stack.push_async_callback(link.close)
            await link.open()
            self._links.append(link)
        until = monotonic() + LINK_UP_S
        while not all(receiver.beliefs for both in self._receivers.values() for receiver in both.values()):
            if monotonic() > until:
                missing = [
                    kind for kind, both in self._receivers.items() if not all(r.beliefs for r in both.values())
                ]
                raise FlightError(f"no position arrived within {LINK_UP_S:g} s over {', '.join(missing)}")
            await asyncio.sleep(_LOOK_S)

    def _exchange(self, link: PositionLink) -> Record:
        """The exchange of keys in flight: when it began, and how long it took."""
        first = max(receiver.beliefs[0].accepted_at for receiver in self._receivers[link.kind].values())
        values: dict[str, Value] = {"first_position_s": round(first, 3)}
        key_at, data_at = link.watch.key_at, link.watch.data_at
        if key_at is not None and data_at is not None:
            values |= {"began_s": round(key_at - self._began_at, 3), "took_s": round(data_at - key_at, 4)}
            self._show(f"{link.kind}: keys exchanged in flight in {1e3 * (data_at - key_at):.1f} ms")
        return Record("exchange", {"link": link.kind.value}, values)

    async def _run_phase(
        self, phase: AttackPhase, attack: AttackPhase, duration_s: float, writer: RecordWriter
    ) -> None:
        before = [(await link.notice(), await link.interventions()) for link in self._links]
        begin_s = self._phases[-1][2] if self._phases else self._now()  # each accepted frame is in a phase
        self._show(f"{begin_s:6.1f} s  {phase}")
        # The replay that was recorded in the first phase goes on.
        if phase is not AttackPhase.REPLAY:
            for link in self._links:
                await link.attack(attack)
        await asyncio.sleep(max(0.0, begin_s + duration_s - self._now()))
        end_s = self._now()
        self._phases.append((phase, begin_s, end_s))
        for link, (notice, interventions) in zip(self._links, before, strict=True):
            counts = (await link.notice()).counts - notice.counts
            frames = Counter(
                provenance
                for receiver in self._receivers[link.kind].values()
                for at, provenance in receiver.frames
                if begin_s <= at < end_s
            )
            values: dict[str, Value] = {
                "begin_s": round(begin_s, 3),
                "end_s": round(end_s, 3),
                "sent": sum(begin_s <= at < end_s for sent in self._sent.values() for at in sent.values()),
                "interventions": await link.interventions() - interventions,
                **{provenance.value: frames[provenance] for provenance in Provenance},
                "noticed": ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items())),
            }
            writer.add(Record("phase", {"link": link.kind.value, "phase": phase.value}, values))

    async def _watch_states(self, writer: RecordWriter) -> None:
        """Record what the daemons report of their link, at each change."""
        last = {link.kind: "" for link in self._links}
        while True:
            for link in self._links:
                notice: LinkNotice = await link.notice()
                if notice.state != last[link.kind]:
                    last[link.kind] = notice.state
                    values: dict[str, Value] = {"at_s": round(self._now(), 3), "state": notice.state}
                    writer.add(Record("state", {"link": link.kind.value}, values))
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

    def _samples(self) -> list[Record]:
        records = []
        for kind, receivers in self._receivers.items():
            for name, receiver in receivers.items():
                flown = self._flown[_other(name)]
                before = AttackPhase.QUIET
                for phase, begin_s, end_s in self._phases:
                    for sample in samples(flown, receiver.beliefs, begin_s, end_s, SAMPLE_S):
                        # An attack has an effect until a position is accepted after its end.
                        is_over = sample.belief.accepted_at >= begin_s
                        cause = before if phase is AttackPhase.QUIET and not is_over else phase
                        point = {"link": kind.value, "aircraft": _other(name), "phase": cause.value}
                        values: dict[str, Value] = {
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
                        records.append(Record("sample", point, values))
                    before = phase
        return records


def _other(name: str) -> str:
    (other,) = set(PAIR) - {name}
    return other
