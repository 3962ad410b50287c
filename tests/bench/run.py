"""A run: the contenders in turn, round by round, with their records."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tests.bench.cable import Cable
from tests.bench.contenders import Contender, NotMeasuredError, Running, last_words
from tests.bench.frames import FrameSet, write_frames
from tests.bench.measure import Bench, at_rate, highest_rate, rotated, until_carried
from tests.bench.traffic import AS_RECORDED, SINK_PORT, Traffic, Worker
from tests.namespaces import NamespaceError
from uavlinkd.lab.evaluation.records import Record, RecordWriter, Status, Value

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Plan:
    """The extent of the measurements. Times in seconds."""

    rounds: int = 5
    rates: tuple[int, ...] = (50, 100, 300, 1_000, 10_000)
    seconds: tuple[float, ...] = (20.0, 12.0, 6.0, 5.0, 3.0)
    """For each rate."""
    flight_s: float = 15.0
    """So much of the flight is carried with its own timing."""
    step_s: float = 1.0
    """One try of the search for the highest rate; 0: it is not searched."""
    packed: int = 8
    """Frames a datagram, in the second search."""


PATIENCE = 20
"""A contender has so many times 0.6 s to carry its first frame."""
QUICK = Plan(rounds=1, rates=(100, 1_000, 10_000), seconds=(6.0, 2.0, 2.0), flight_s=4.0, step_s=0.0)


@contextmanager
def laboratory(frames: FrameSet) -> Iterator[Bench]:
    """Two hosts, the generator and the sink."""
    with tempfile.TemporaryDirectory(prefix="uavbench-") as folder, Cable() as cable:
        path = Path(folder) / "frames"
        write_frames(path, frames)
        sink = Worker(cable.right, "sink", str(SINK_PORT))
        yield Bench(cable, Traffic(Worker(cable.left, "generator", str(path)), sink))


@contextmanager
def at_work(contender: Contender, bench: Bench) -> Iterator[Running]:
    """Start a contender and wait until it carries frames. Raises NotMeasuredError if it does not."""
    reason = contender.why_not()
    if reason is not None:
        raise NotMeasuredError(reason)
    with tempfile.TemporaryDirectory(prefix="uavbench-") as folder:
        try:
            running = contender.start(bench.cable, Path(folder))
            until_carried(bench, running, PATIENCE)
            yield running
        except (NotMeasuredError, NamespaceError) as error:
            raise NotMeasuredError(f"{error}{last_words(Path(folder))}") from None
        finally:
            bench.cable.left.end_all_but(bench.traffic.processes)
            bench.cable.right.end_all_but(bench.traffic.processes)


class Run:
    """Measures, and writes records."""

    def __init__(self, plan: Plan, bench: Bench, writer: RecordWriter, say: Say) -> None:
        self._plan = plan
        self._bench = bench
        self._writer = writer
        self._say = say

    def all(self, contenders: Sequence[Contender]) -> None:
        """Measure all of them in each round. A contender that is not installed is reported once and left out."""
        left = {contender.name: contender for contender in contenders}
        for number in range(self._plan.rounds):
            for name in rotated(list(left), number):
                self._say(f"round {number + 1} of {self._plan.rounds}: {name}")
                if not self._contender(left[name], number):
                    del left[name]

    def _contender(self, contender: Contender, number: int) -> bool:
        """Measure one; returns whether to try it in the next round."""
        try:
            with at_work(contender, self._bench) as running:
                self._measure(contender.name, number, running)
        except NotMeasuredError as error:
            self._failed("contender", {"contender": contender.name, "round": number}, str(error))
        return contender.why_not() is None

    def _measure(self, name: str, number: int, running: Running) -> None:
        plan, bench = self._plan, self._bench
        for rate, seconds in zip(plan.rates, plan.seconds, strict=True):
            point: dict[str, Value] = {"contender": name, "round": number, "rate": rate, "per_datagram": 1}
            self.record("rate", point, partial(at_rate, bench, running, rate, seconds))
        if plan.flight_s:
            point = {"contender": name, "round": number, "per_datagram": 1}
            self.record("flight", point, partial(at_rate, bench, running, AS_RECORDED, plan.flight_s))
        if plan.step_s:
            for per_datagram in (1, plan.packed):
                point = {"contender": name, "round": number, "per_datagram": per_datagram}
                self.record("highest", point, partial(highest_rate, bench, running, plan.step_s, per_datagram))

    def record(self, kind: str, point: Mapping[str, Value], measure: Callable[[], Mapping[str, Value]]) -> None:
        """Measure and record, or record the reason of a failure."""
        try:
            values = measure()
        except NotMeasuredError as error:
            self._failed(kind, point, str(error))
            return
        self._writer.add(Record(kind, point, values))
        self._say("  " + ", ".join(f"{name} {_short(value)}" for name, value in values.items() if name in _SHOWN))

    def _failed(self, kind: str, point: Mapping[str, Value], reason: str) -> None:
        self._writer.add(Record(kind, point, status=Status.FAILED, reason=reason))
        self._say(f"  not measured: {reason}")


_SHOWN = ("rate", "loss", "cpu_left_us", "cpu_right_us", "wire_bytes_per_frame", "highest", "late_p99_s")


def _short(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
