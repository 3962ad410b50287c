"""The log of a run: every intervention, in JSON lines; floods are counted once they are known.

Of each attack and each thing that it does, the first ``detail`` interventions stand there one by one. The others are
summed up, so a flood fills no disk.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path

from structlog.typing import FilteringBoundLogger

from uavlinkd.ops.log import LogFile
from uavlinkd.lab.mitm.attack import NEVER, Intervention

SUM_INTERVAL_S = 10.0
"""How often what is no longer told one by one is summed up."""


class Journal:
    """Adds to a file, where there is one, and tells the operator's log what begins and how it goes on."""

    def __init__(self, path: Path | None, log: FilteringBoundLogger, now: float, detail: int) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        """Interventions by attack and by what was done."""
        self._began_at = now
        self._log = log
        self._detail = detail
        self._unsaid: Counter[tuple[str, str]] = Counter()
        self._told: Counter[tuple[str, str]] = Counter()
        self._sum_at = NEVER
        self._descriptor = None if path is None else os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        self._file = None if self._descriptor is None else LogFile(self._descriptor)

    def event(self, name: str, now: float, **facts: object) -> None:
        """A line about the run itself."""
        self._log.info(name, **facts)
        self._write({"event": name, "at": round(now - self._began_at, 6), **facts})

    def add(self, done: Intervention) -> None:
        """An intervention."""
        key = (done.attack, done.what.value)
        self.counts[key] += 1
        if self.counts[key] == 1:
            self._log.warning("attack_began", attack=done.attack, what=key[1], way=str(done.way), detail=done.detail)
        if self._sum_at == NEVER:
            self._sum_at = done.at + SUM_INTERVAL_S
        if self.counts[key] > self._detail:
            self._unsaid[key] += 1
        elif self._file is not None:
            facts = done.to_dict()
            facts["at"] = round(done.at - self._began_at, 6)
            self._write({"event": "intervention", **facts})

    def flush(self, now: float) -> None:
        """Sum up, when it is time to."""
        if now < self._sum_at:
            return
        self._sum_at = NEVER
        at = None if now == NEVER else round(now - self._began_at, 6)
        for (attack, what), count in self._unsaid.items():
            self._write({"event": "interventions_summed", "at": at, "attack": attack, "what": what, "count": count})
        self._unsaid.clear()
        for key, count in self.counts.items():
            if count > self._told[key]:
                self._log.warning("attack_went_on", attack=key[0], what=key[1], count=count)
                self._told[key] = count

    def next_flush(self) -> float:
        """When :meth:`flush` has something to do."""
        return self._sum_at

    def close(self) -> None:
        """Write what is left."""
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
        if self._file.lost and not lost:  # the disk is full: the man in the middle goes on
            self._log.error("journal_not_written")
