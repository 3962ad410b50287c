"""One running contender: the cost of a frame at a given rate, and the highest rate without loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.bench.cable import Cable
from tests.bench.contenders import NotMeasuredError, Running
from tests.bench.traffic import Flow, Traffic
from uavlinkd.lab.evaluation.records import EvaluationError, Value, cpu_seconds

NO_LOSS: Final = 0.001
"""Up to this share of loss, a rate passes: one pause of the machine is not the contender's limit."""
KEPT_PACE: Final = 0.97
"""Share of the requested rate. If the generator does not reach it, the machine is the limit."""
MOST_BEHIND_S: Final = 0.1
"""If more than this waits in buffers at the end of an attempt, they would overflow in a longer one."""
LOWEST_RATE: Final = 500
HIGHEST_RATE: Final = 2_000_000
CLOSE_ENOUGH: Final = 1.05
"""The search ends when the lowest failed rate is within this of the highest passed rate."""
TRIES: Final = 2
"""A rate passes if one of so many attempts does: other processes use the machine too."""
EVEN_S: Final = 0.02
"""If one of a hundred datagrams left later than this, the machine paused: the flow was uneven,
and is measured again."""
DISTURBED_MOST: Final = 3
"""Then the measurement is used as it is."""
WARM_UP: Final = (1000, 0.5)
"""Frames a second, and seconds."""


@dataclass(frozen=True, slots=True)
class Used:
    """Processor time that each side has used so far, in seconds."""

    left: float
    right: float


@dataclass(frozen=True, slots=True)
class Bench:
    """The environment of a measurement."""

    cable: Cable
    traffic: Traffic


def used(running: Running) -> Used:
    """All threads of all processes of each side. Raises NotMeasuredError if one has ended."""
    for process in (*running.left, *running.right):
        if process.poll() is not None:
            raise NotMeasuredError(f"it ended with status {process.returncode}")
    try:
        left = sum(cpu_seconds(process.pid) for process in running.left)
        return Used(left, sum(cpu_seconds(process.pid) for process in running.right))
    except EvaluationError as error:
        raise NotMeasuredError(f"it has ended: {error}") from None


def resident_bytes(pid: int) -> int:
    """Memory of a process that is in RAM (VmRSS of proc_pid_status(5)). Raises NotMeasuredError if it has ended."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    raise NotMeasuredError(f"it has ended: the memory of process {pid} cannot be read")


def until_carried(bench: Bench, running: Running, tries: int) -> None:
    """Until frames come through, then until all do at an easy rate. Raises NotMeasuredError if they do not."""
    for _ in range(tries):
        if bench.traffic.flow(running.target, 100, 0.3).received:
            break
        used(running)  # it is still there
    else:
        raise NotMeasuredError("it carries no frame")
    flow = bench.traffic.flow(running.target, *WARM_UP)
    if not flow.received:
        raise NotMeasuredError("it carried frames, and then no more")


def at_rate(bench: Bench, running: Running, rate: float, seconds: float, per_datagram: int = 1) -> dict[str, Value]:
    """What frames cost at this rate. CPU is that of one frame which arrived, in microseconds, by side."""
    for disturbed in range(DISTURBED_MOST):  # noqa: B007  recorded: how often before it was taken
        wire, cpu = bench.cable.counted(), used(running)
        flow = bench.traffic.flow(running.target, rate, seconds, per_datagram)
        spent, crossed = used(running), bench.cable.counted().since(wire)
        if flow.is_even(EVEN_S):
            break
    if not flow.received:
        raise NotMeasuredError(f"no frame came through at {rate:g} a second")
    return {
        **flow_values(flow),
        "cpu_left_us": (spent.left - cpu.left) / flow.received * 1e6,
        "cpu_right_us": (spent.right - cpu.right) / flow.received * 1e6,
        "disturbed": disturbed,
        "wire_packets": crossed.packets,
        "wire_bytes": crossed.bytes,
        "wire_bytes_per_frame": crossed.bytes / flow.received,
        "rss_left": sum(resident_bytes(process.pid) for process in running.left),
        "rss_right": sum(resident_bytes(process.pid) for process in running.right),
    }


def flow_values(flow: Flow) -> dict[str, Value]:
    """What is recorded of a flow."""
    return {
        "sent": flow.sent,
        "received": flow.received,
        "others": flow.others,
        "garbage": flow.garbage,
        "datagrams_received": flow.datagrams,
        "seconds": flow.seconds,
        "rate": flow.rate,
        "loss": flow.loss,
        "behind_s": flow.behind_s,
        "latencies_s": [round(latency, 7) for latency in flow.latencies_s],
        **flow.evenness,
    }


def highest_rate(bench: Bench, running: Running, step_s: float, per_datagram: int = 1) -> dict[str, Value]:
    """The highest rate at which no more than :data:`NO_LOSS` is lost: doubled until it fails, then halved between.

    Each try is recorded: the rate asked for, the one reached, the part lost, the seconds behind at its end.
    """
    asked: list[float] = []
    reached: list[float] = []
    lost: list[float] = []
    behind: list[float] = []

    def passes(rate: float) -> bool:
        failed = 0
        for _ in range(TRIES + DISTURBED_MOST):
            flow = bench.traffic.flow(running.target, rate, step_s, per_datagram)
            asked.append(rate)
            reached.append(flow.rate)
            lost.append(flow.loss)
            behind.append(flow.behind_s)
            used(running)
            if flow.loss <= NO_LOSS and flow.rate >= KEPT_PACE * rate and flow.behind_s <= MOST_BEHIND_S:
                return True
            failed += flow.is_even(EVEN_S) or flow.rate < KEPT_PACE * rate
            if failed == TRIES:
                break
        return False

    best, failed = _double(passes, LOWEST_RATE * 4 * per_datagram)
    while best and failed / best > CLOSE_ENOUGH:
        middle = (best * failed) ** 0.5
        if passes(middle):
            best = middle
        else:
            failed = middle
    return {"highest": best, "asked": asked, "reached": reached, "lost": lost, "behind_s": behind}


def _double(passes: Callable[[float], bool], first: float) -> tuple[float, float]:
    """The highest rate of a doubling row that passes, and the next, which fails; where none passes, (0, least)."""
    rate = first
    if passes(rate):
        while rate < HIGHEST_RATE and passes(rate * 2):
            rate *= 2
        return rate, rate * 2
    while rate > LOWEST_RATE:
        rate /= 2
        if passes(rate):
            return rate, rate * 2
    return 0.0, rate


def rotated(names: Sequence[str], by: int) -> list[str]:
    """Another one first in each round, so that none is always measured after the same other."""
    start = by % max(1, len(names))
    return [*names[start:], *names[:start]]
