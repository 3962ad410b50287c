"""``uavlinkd evaluate paths``: a vehicle with two radios, one of which fails, over real daemons and without them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from datetime import UTC, datetime
from pathlib import Path

from uavlinkd.lab.child_processes import private_folder
from uavlinkd.lab.evaluation.machine import load, machine_facts
from uavlinkd.lab.evaluation.paths_plan import NAME, PathsSettings
from uavlinkd.lab.evaluation.paths_trial import PathTrial
from uavlinkd.lab.evaluation.records import Record, RecordWriter

Show = Callable[[str], None]


async def run_paths(out: Path, settings: PathsSettings, show: Show) -> None:
    """Play every scenario with every means, and write the records to ``out``.

    Raises:
        PathsError, DroneError: a trial failed.
        TlogError: a recorded flight cannot be read.
        OSError: the results cannot be written.
    """
    facts = {
        **machine_facts(),
        "quick": settings.quick,
        "seed": settings.seed,
        "repeats": settings.repeats,
        "began": datetime.now(UTC).isoformat(),
    }
    with private_folder("uavlinkd-") as folder, RecordWriter(out, NAME, facts) as writer:
        for round_, planned in enumerate(settings.rounds()):
            trials = [
                PathTrial(plan, means, settings.seed, folder / f"{round_}-{number}")
                for number, (plan, means) in enumerate(planned)
            ]
            for record in await _play(trials, show):
                writer.add(record)
        writer.add(Record("end", {}, {"load_after": load()}))


async def _play(trials: Sequence[PathTrial], show: Show) -> list[Record]:
    """Play trials at the same time. They begin together, after all links are up."""
    show("; ".join(f"{trial.plan.scenario}: {trial.means}" for trial in trials))
    async with AsyncExitStack() as stack:
        for trial in trials:
            stack.push_async_callback(trial.close)
        await asyncio.gather(*(trial.open() for trial in trials))
        await asyncio.gather(*(trial.play() for trial in trials))
    return [record for trial in trials for record in trial.records()]
