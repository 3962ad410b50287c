"""``uavlinkd evaluate timing``: the measurements, their order and their repetitions."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from uavlinkd.core.suites import SUITES, X25519
from uavlinkd.lab.evaluation.energy import DEFAULT_WATTS_PER_CORE
from uavlinkd.lab.evaluation.machine import EnergyMeter, load, machine_facts
from uavlinkd.lab.evaluation.pair import LinkChoice
from uavlinkd.lab.evaluation.records import Record, RecordWriter, Status, Value
from uavlinkd.lab.evaluation.timing_core import measure_core
from uavlinkd.lab.evaluation.timing_frames import measure_frames
from uavlinkd.lab.evaluation.timing_handshake import measure_handshake, measure_rekeys, point_of
from uavlinkd.lab.evaluation.timing_mac import measure_macs
from uavlinkd.lab.evaluation.timing_paper import DH_BITS, PAPER_LIMIT_S, PaperEnds, paper_points

T = TypeVar("T")

NAME = "timing"
"""The name of the record files ``timing.jsonl`` and ``timing.csv``."""
MAC_KEY_BITS = (256, 512, 1024, 2048)
"""The lengths that a configuration may have."""
FULL_REPEATS = 30
_ONLY_WITH_PAPER = DH_BITS[-1]
_NOT_IN_QUICK = "not in a quick run"


@dataclass(frozen=True, slots=True)
class TimingSettings:
    """The options of the evaluation.

    ``repeats``: of each point. ``quick``: some points, once. ``paper``: also the paper's largest group, each
    point once. ``limit_s``: the time limit of one exchange of the paper's method. ``seed``: of the order of the
    measurements and of their data; keys come from the system. ``watts_per_core``: for the estimate of energy.
    """

    repeats: int = FULL_REPEATS
    quick: bool = False
    paper: bool = False
    limit_s: float = PAPER_LIMIT_S
    seed: int = 0
    watts_per_core: float = DEFAULT_WATTS_PER_CORE

    @property
    def patience_s(self) -> float:
        """The time limit of one exchange of the paper's method."""
        return min(self.limit_s, 2.0) if self.quick else self.limit_s

    @property
    def rekeys(self) -> int:
        """The number of rekeys of each suite; each takes 1 s, the shortest configurable interval."""
        return 1 if self.quick else min(self.repeats, 10)

    @property
    def frames(self) -> int:
        """The number of frames on each link."""
        return 100 if self.quick else 1000

    @property
    def tags(self) -> int:
        """The number of tags in each batch."""
        return 500 if self.quick else 20000


def run_timing(folder: Path, settings: TimingSettings, console: Console | None = None) -> list[Record]:
    """Run all measurements, write the records to ``folder``, and return them."""
    started = time.monotonic()
    facts: dict[str, Value] = {
        **machine_facts(),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": settings.seed,
        "repeats": 1 if settings.quick else settings.repeats,
        "quick": settings.quick,
        "paper": settings.paper,
        "limit_s": settings.patience_s,
        "watts_per_core": settings.watts_per_core,
    }
    with RecordWriter(folder, NAME, facts) as writer, _bars(console) as start_bar:
        run = _Run(settings, writer, start_bar)
        run.macs()
        run.core()
        run.frames()
        run.rekeys()
        run.exchanges()
        ended: dict[str, Value] = {"elapsed_s": time.monotonic() - started, "load_after": load()}
        writer.add(Record("end", {}, ended))
        return writer.records


class _Bar:
    """One progress bar. It is drawn between measurements: a drawing thread would affect their times."""

    def __init__(self, progress: Progress, task: TaskID) -> None:
        self._progress = progress
        self._task = task

    def show(self, text: str = "") -> None:
        """Show the current measurement."""
        if text:
            self._progress.update(self._task, point=text)
        self._progress.refresh()

    def advance(self, steps: int = 1) -> None:
        """Count finished measurements."""
        self._progress.update(self._task, advance=steps)
        self._progress.refresh()


@contextmanager
def _bars(console: Console | None) -> Iterator[Callable[[str, int], _Bar]]:
    columns = (
        TextColumn("{task.description:<20}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[point]}"),
    )
    with Progress(*columns, console=console or Console(stderr=True), auto_refresh=False) as progress:
        yield lambda text, total: _Bar(progress, progress.add_task(text, total=total, point=""))


class _Run:
    def __init__(self, settings: TimingSettings, writer: RecordWriter, start_bar: Callable[[str, int], _Bar]) -> None:
        self._settings = settings
        self._writer = writer
        self._start_bar = start_bar
        self._random = random.Random(settings.seed)  # noqa: S311  not for keys
        self._meter = EnergyMeter()
        self._repeats = 1 if settings.quick else settings.repeats

    def macs(self) -> None:
        bar = self._start_bar("tags", 1)
        self._add_all(measure_macs(self._settings.tags))
        bar.advance()

    def core(self) -> None:
        work = self._shuffled(_grid(), self._repeats)
        bar = self._start_bar("handshakes, core", len(work))
        measure_core(LinkChoice(X25519))  # the first use is slow
        for choice in work:
            self._writer.add(measure_core(choice))
        bar.advance(len(work))

    def frames(self) -> None:
        links = [LinkChoice(suite) for suite in SUITES.values()]
        links += [LinkChoice(X25519, bits) for bits in MAC_KEY_BITS if bits != 256]
        links += [LinkChoice(X25519, confidential=True)]
        work = [(choice, False) for choice in links] + [(LinkChoice(X25519), True)]
        chosen = [link for link in work if not self._settings.quick or link[0] == LinkChoice(X25519)]
        bar = self._start_bar("frames", len(chosen))
        for choice, with_relay in work:
            if (choice, with_relay) not in chosen:
                self._skip("frames", {**point_of(choice), "relay": with_relay}, _NOT_IN_QUICK)
                continue
            bar.show(choice.suite.name)
            self._writer.add(measure_frames(choice, self._settings.frames, self._meter, with_relay=with_relay))
            bar.advance()

    def rekeys(self) -> None:
        chosen = [suite for suite in SUITES.values() if not self._settings.quick or suite.name in _QUICK_REKEYS]
        bar = self._start_bar("rekeys", len(chosen) * self._settings.rekeys)
        for suite in SUITES.values():
            choice = LinkChoice(suite)
            if suite not in chosen:
                self._skip("rekey", point_of(choice), _NOT_IN_QUICK)
                continue
            bar.show(suite.name)
            self._add_all(measure_rekeys(choice, self._settings.rekeys))
            bar.advance(self._settings.rekeys)

    def exchanges(self) -> None:
        """Measure the daemons and the paper's method in random order, so that load affects both equally."""
        grid = list(_grid())
        chosen = [choice for choice in grid if not self._settings.quick or _is_quick(choice)]
        for choice in grid:
            if choice not in chosen:
                self._skip("handshake", point_of(choice), _NOT_IN_QUICK)
        points, last = self._paper_points()
        often: list[LinkChoice | dict[str, Value]] = [*chosen, *points]
        work = [*self._shuffled(often, self._repeats), *last]
        of_daemons = sum(isinstance(point, LinkChoice) for point in work)
        bar = self._start_bar("handshakes, daemons", of_daemons)
        paper_bar = self._start_bar("the paper's method", len(work) - of_daemons)
        with PaperEnds(self._settings.seed) as ends:
            for point in work:
                if isinstance(point, LinkChoice):
                    bar.show(f"{point.suite.name}, HMAC key of {point.mac_key_bits} bits")
                    self._writer.add(measure_handshake(point, self._meter))
                    bar.advance()
                else:
                    paper_bar.show(f"{point['group']} group of {point['dh_bits']} bits")
                    self._writer.add(ends.measure(point, self._settings.patience_s, paper_bar.show))
                    paper_bar.advance()

    def _paper_points(self) -> tuple[list[dict[str, Value]], list[dict[str, Value]]]:
        """The points that are repeated, and those that run once and last, because each takes up to the limit."""
        often: list[dict[str, Value]] = []
        last: list[dict[str, Value]] = []
        for point in paper_points():
            if not (point["dh_bits"] == _ONLY_WITH_PAPER and point["group"] == "made"):
                often.append(point)
            elif self._settings.paper:
                last.append(point)
            else:
                self._skip("paper", point, "runs only with --paper")
        return often, last

    def _shuffled(self, points: Iterable[T], repeats: int) -> list[T]:
        """Every point ``repeats`` times in random order, so that load affects all points equally."""
        work = [point for point in points for _ in range(repeats)]
        self._random.shuffle(work)
        return work

    def _add_all(self, records: Iterable[Record]) -> None:
        for record in records:
            self._writer.add(record)

    def _skip(self, kind: str, point: dict[str, Value], reason: str) -> None:
        self._writer.add(Record(kind, point, {}, Status.SKIPPED, reason))


_QUICK_REKEYS = ("ffdhe4096",)


def _grid() -> Iterator[LinkChoice]:
    return (LinkChoice(suite, bits) for suite in SUITES.values() for bits in MAC_KEY_BITS)


def _is_quick(choice: LinkChoice) -> bool:
    """Every suite with the shortest key, and the longest key once."""
    return choice.mac_key_bits == MAC_KEY_BITS[0] or (
        choice.suite is X25519 and choice.mac_key_bits == MAC_KEY_BITS[-1]
    )
