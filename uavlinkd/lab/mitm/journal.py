"""The log of a run: one JSON line per intervention, and totals for floods.

The first ``detail`` interventions of each attack and operation have a line each. Later ones are summed up, so that a
flood does not fill the disk.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path

from structlog.typing import FilteringBoundLogger

from uavlinkd.lab.mitm.attack import NEVER, Intervention
from uavlinkd.ops.log import LogFile

SUM_INTERVAL_S = 10.0
"""How often the interventions without a line of their own are summed up."""


class Journal:
    """Appends to the file, if there is one, and logs the start and the totals of each attack for the operator."""

    def __init__(self, path: Path | None, log: FilteringBoundLogger, now: float, detail: int) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        """Interventions by attack and operation."""
        self._began_at = now
        self._log = log
        self._detail = detail
        self._not_logged: Counter[tuple[str, str]] = Counter()
        self._logged: Counter[tuple[str, str]] = Counter()
        self._sum_at = NEVER
        self._descriptor = None if path is None else os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        self._file = None if self._descriptor is None else LogFile(self._descriptor)

    def event(self, name: str, now: float, **facts: object) -> None:
        """Log an event of the run itself."""
        self._log.info(name, **facts)
        self._write({"event": name, "at": round(now - self._began_at, 6), **facts})

    def add(self, done: Intervention) -> None:
        """Record an intervention."""
        key = (done.attack, done.operation.value)
        self.counts[key] += 1
        if self.counts[key] == 1:
            self._log.warning(
                "attack_began",
                attack=done.attack,
                operation=key[1],
                direction=str(done.direction),
                detail=done.detail,
            )
        if self._sum_at == NEVER:
            self._sum_at = done.at + SUM_INTERVAL_S
        if self.counts[key] > self._detail:
            self._not_logged[key] += 1
        elif self._file is not None:
            facts = done.to_dict()
            facts["at"] = round(done.at - self._began_at, 6)
            self._write({"event": "intervention", **facts})

    def flush(self, now: float) -> None:
        """Log the totals, if they are due."""
        if now < self._sum_at:
            return
        self._sum_at = NEVER
        at = None if now == NEVER else round(now - self._began_at, 6)
        for (attack, operation), count in self._not_logged.items():
            self._write(
                {"event": "interventions_summed", "at": at, "attack": attack, "operation": operation, "count": count}
            )
        self._not_logged.clear()
        for key, count in self.counts.items():
            if count > self._logged[key]:
                self._log.warning("attack_continued", attack=key[0], operation=key[1], count=count)
                self._logged[key] = count

    def next_flush(self) -> float:
        """The time of the next call of :meth:`flush`."""
        return self._sum_at

    def close(self) -> None:
        """Write the last totals and close the file."""
        self._sum_at = min(self._sum_at, 0.0)
        self.flush(NEVER)
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = self._file = None

    def _write(self, facts: dict[str, object]) -> None:
        if self._file is None:
            return
        lost = self._file.lost
        if lost:
            facts = {**facts, "lines_lost_before": lost}
        self._file.write(json.dumps(facts) + "\n")
        if self._file.lost and not lost:  # a full disk does not stop the proxy
            self._log.error("journal_not_written")
