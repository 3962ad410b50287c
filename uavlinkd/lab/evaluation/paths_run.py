"""``uavlinkd evaluate paths``: a vehicle with two radios, one of which fails, over real daemons and without them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any, Final

from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.frame import Evaluation, Work
from uavlinkd.lab.evaluation.paths_plan import (
    DEAD_S,
    RADIOS,
    STATION,
    VEHICLE,
    Means,
    PathFailure,
    PathsPlan,
    PathsSettings,
    RadioChange,
)
from uavlinkd.lab.evaluation.paths_report import PathsFindings, paths_problems, paths_summary, sections
from uavlinkd.lab.evaluation.paths_traffic import DaemonsLink, PathLink, PathRadio, TrafficLog, flows_of
from uavlinkd.lab.evaluation.records import Record, Value
from uavlinkd.lab.evaluation.stage import until
from uavlinkd.lab.sim.tlog import play_tlog, read_tlog
from uavlinkd.mavlink.frames import parse_frame
from uavlinkd.mavlink.payloads import HEARTBEAT, claims_to_be_ground_station

SETTLE_S: Final = 6.0
"""How long a link may take to use all its paths, before the scenario begins."""
GRACE_S: Final = 1.5
"""How long frames may still arrive after the last one was sent."""
RETURN_LIMIT_S: Final = 10.0
"""How long a dead path may take to be used again before it dies again."""
WORKS_S: Final = 4.0
"""How long both paths work before one dies again: a path that returns is usable again after 2 s and three answers."""
_LOOK_S: Final = 0.05


async def run_paths(work: Work[PathsSettings]) -> dict[str, Any]:
    """Play every scenario with every means.

    Raises:
        EvaluationError, DroneError: a trial failed.
        TlogError: a recorded flight cannot be read.
    """
    for round_, planned in enumerate(work.settings.rounds()):
        work.show("; ".join(f"{plan.scenario}: {means}" for plan, means in planned))
        async with AsyncExitStack() as stack:
            trials = []
            for number, (plan, means) in enumerate(planned):
                trial = PathTrial(plan, means, work.settings.seed, work.folder / f"{round_}-{number}")
                stack.push_async_callback(trial.close)
                trials.append(trial)
            # They begin together, after all links are up.
            await asyncio.gather(*(trial.open() for trial in trials))
            await asyncio.gather(*(trial.play() for trial in trials))
        for trial in trials:
            for record in trial.records():
                work.add(record)
    return {}


class PathTrial:
    """One scenario with one of the means. ``open`` it, ``play`` it, ``close`` it; then it has its records."""

    def __init__(self, plan: PathsPlan, means: Means, seed: int, folder: Path) -> None:
        self.plan = plan
        self.means = means
        self._traffic = TrafficLog(flows_of(plan.scenario))
        # Each path has its own losses and jitter; they are the same for all means.
        self._radios = {
            number: PathRadio(plan.radios[number], len(plan.radios) * seed + number)
            for number in RADIOS.get(means, (0, 1))
        }
        if means is Means.DUPLICATES:
            self._link = PathLink(self._radios, self._traffic.on_received)
        else:
            self._link = DaemonsLink(self._radios, self._traffic.on_received, folder, plan)
            self._link.settings = {"redundancy": "all"} if means is Means.ALL else {}
        self._failures: list[PathFailure] = []
        self._talking: asyncio.Task[None] | None = None
        self._duration_s = 0.0

    @property
    def point(self) -> dict[str, Value]:
        return {**self.plan.point, "means": self.means.value}

    async def open(self) -> None:
        """Start, and wait until frames arrive in both directions and each path carries some.

        Raises:
            EvaluationError: there is no link in time.
            DroneError: a daemon ended.
        """
        await self._link.open()
        self._talking = asyncio.create_task(self._traffic.talk(self._link.send))
        await until(self._is_linked, f"{self.point}: no link")
        # Daemons that use one path only are not an error here: the figures show it.
        await self._until(lambda: all(self._is_used(number, 0.0) for number in self._radios), SETTLE_S)

    async def _is_linked(self) -> bool:
        await self._link.check()
        return self._traffic.arrived_from == {VEHICLE, STATION}

    async def play(self) -> None:
        """Play the scenario: from here on, everything counts."""
        self._traffic.begin()
        for radio in self._radios.values():
            radio.watch.begin(self._traffic.began_at)
        if self.plan.tlog is not None:
            await self._stop_talking()
            await self._play_flight(self.plan.tlog)
        elif self.plan.deaths:
            for _ in range(self.plan.deaths):
                await self._die()
        else:
            await self._play_changes()
        self._duration_s = self._now()
        await self._stop_talking()
        await asyncio.sleep(GRACE_S)

    async def close(self) -> None:
        await self._stop_talking()
        await self._link.close()

    def records(self) -> list[Record]:
        records = self._traffic.records(self.point) if self.plan.tlog is None else []
        for number, radio in self._radios.items():
            watch = radio.watch
            values: dict[str, Value] = {"bytes": watch.bytes, "datagrams": watch.datagrams}
            for (sender, cls), times in watch.carried.items():
                values[f"{sender}_{cls.value}_s"] = [round(time_s, 3) for time_s in times]
            records.append(Record("radio", {**self.point, "radio": number}, values))
        for failure in self._failures:
            times_s: dict[str, Value] = {"at_s": round(failure.at_s, 4), "until_s": round(failure.until_s, 4)}
            records.append(Record("failure", {**self.point, "radio": failure.radio}, times_s))
        values = {"duration_s": round(self._duration_s, 3), "sender_late_s": round(self._traffic.late_s, 4)}
        records.append(Record("trial", self.point, values))
        return records

    def _now(self) -> float:
        return monotonic() - self._traffic.began_at

    async def _stop_talking(self) -> None:
        if self._talking is not None:
            self._talking.cancel()
            await asyncio.gather(self._talking, return_exceptions=True)
            self._talking = None

    async def _until(self, condition: Callable[[], bool], limit_s: float) -> None:
        for _ in range(round(limit_s / _LOOK_S)):
            if condition():
                return
            await asyncio.sleep(_LOOK_S)

    def _is_used(self, number: int, since_s: float) -> bool:
        """Whether both ends sent critical frames along a path since then."""
        carried = self._radios[number].watch.carried
        return all(max(carried[end, Class.CRITICAL], default=-1.0) >= since_s for end in (VEHICLE, STATION))

    def _stream_radio(self) -> int:
        """The radio that carried the vehicle's stream last."""
        return max(
            self._radios,
            key=lambda number: max(self._radios[number].watch.carried[VEHICLE, Class.STREAM], default=-1.0),
        )

    async def _play_changes(self) -> None:
        real = {0: 0, 1: 1}
        for position, change in enumerate(self.plan.changes):
            await asyncio.sleep(max(0.0, change.at_s - self._now()))
            one, other = self.plan.radios
            if position == 0 and one == other and len(self._radios) > 1 and self._stream_radio() == 1:
                real = {0: 1, 1: 0}  # of equal radios, number 0 of the plan is the one that carries the stream now
            number = real[change.radio]
            if number in self._radios:
                self._radios[number].change(change)
        self._failures = [
            replace(failure, radio=real[failure.radio])
            for failure in self.plan.failures
            if real[failure.radio] in self._radios
        ]
        await asyncio.sleep(max(0.0, self.plan.duration_s - self._now()))

    async def _die(self) -> None:
        """The path that carries the stream dies, and returns. Wait until it is used again."""
        await asyncio.sleep(WORKS_S)
        number = self._stream_radio()
        radio, at_s = self._radios[number], self._now()
        radio.change(RadioChange(at_s, number, {"loss": 1.0}))
        await asyncio.sleep(DEAD_S)
        until_s = self._now()
        radio.change(RadioChange(until_s, number))
        self._failures.append(PathFailure(number, at_s, until_s))
        await self._until(lambda: self._is_used(number, until_s), RETURN_LIMIT_S)

    async def _play_flight(self, path: Path) -> None:
        """Play a recorded flight: each end sends its own frames."""
        assert isinstance(self._link, DaemonsLink)
        log = await asyncio.to_thread(read_tlog, path)
        systems = {record.system_id for record in log.records}
        stations = {
            record.system_id
            for record in log.records
            if (frame := parse_frame(record.frame)) is not None
            and frame.header.msgid == HEARTBEAT
            and claims_to_be_ground_station(frame)
        }
        speakers = {VEHICLE: systems - stations, STATION: stations}
        await asyncio.gather(
            *(
                play_tlog(log, self._link.endpoints[end], system_ids=ids, seconds=self.plan.duration_s)
                for end, ids in speakers.items()
            )
        )


PATHS = Evaluation(
    name="paths",
    title="Two radios between a vehicle and its ground station",
    settings=PathsSettings,
    run=run_paths,
    findings=PathsFindings,
    sections=sections,
    problems=paths_problems,
    summary=paths_summary,
    draw="draw_paths",
)
