"""The generator and the sink, as seen from the bench: one order, one flow, what became of it."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.bench.namespaces import Host

REPOSITORY: Final = Path(__file__).parents[2]
SINK_PORT: Final = 14600
SETTLED_S: Final = 0.25
"""When nothing more has come for this long, nothing will."""
POLL_S: Final = 0.03


class TrafficError(Exception):
    """The generator or the sink has ended. The message is for a person."""


@dataclass(frozen=True, slots=True)
class Flow:
    """What was sent, what came of it. Times in seconds."""

    sent: int
    received: int
    others: int
    garbage: int
    datagrams: int
    """Those that the frames came in."""
    seconds: float
    arrived: int
    """Of the frames, those that had come when the last was sent."""
    latencies_s: tuple[float, ...]
    evenness: dict[str, float]
    """How late the generator was, and how much it sent in one go."""

    @property
    def loss(self) -> float:
        """The part that did not come; what came twice makes it negative."""
        return 1 - self.received / self.sent

    @property
    def behind_s(self) -> float:
        """For how long the last frames still waited somewhere, at the rate at which they were sent."""
        return (self.received - self.arrived) / self.rate

    def is_even(self, late_s: float) -> bool:
        """Whether the generator sent 99 of 100 datagrams no later than this."""
        return self.evenness.get("late_p99_s", 0.0) <= late_s

    @property
    def rate(self) -> float:
        """Frames a second that were really sent."""
        return self.sent / self.seconds


class Worker:
    """A process of ours that answers each line with one of JSON."""

    def __init__(self, host: Host, module: str, *arguments: str) -> None:
        command = [sys.executable, "-m", f"tests.bench.{module}", *arguments]
        self.process: subprocess.Popen[bytes] = host.start(command, folder=REPOSITORY, pipes=True)
        self._name = module
        self.answer()

    def ask(self, line: str) -> dict[str, Any]:
        """The answer to a line.

        Raises:
            TrafficError: it has ended.
        """
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(line.encode() + b"\n")
            self.process.stdin.flush()
        except OSError as error:
            raise TrafficError(f"the {self._name} has ended: {error}") from None
        return self.answer()

    def answer(self) -> dict[str, Any]:
        """The next line."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.process.wait()
            raise TrafficError(f"the {self._name} has ended with status {self.process.returncode}")
        answer: dict[str, Any] = json.loads(line)
        return answer


class Traffic:
    """Who sends on the left, and a sink on the right."""

    def __init__(self, sender: Worker, sink: Worker) -> None:
        self._sender = sender
        self._sink = sink
        self.processes = (sink.process, sender.process)
        """Not those of any contender."""

    def flow(self, target: tuple[str, int], rate: float, seconds: float, per_datagram: int = 1) -> Flow:
        """So many frames a second to this address; ends when all came, or nothing more comes."""
        self._sink.ask("reset")
        order = {"host": target[0], "port": target[1], "rate": rate, "seconds": seconds}
        sent = self._sender.ask(json.dumps({**order, "per_datagram": per_datagram}))
        arrived = self.count()
        self.settle(sent["frames"])
        came = self._sink.ask("take")
        evenness = {
            name: sent[name] for name in ("late_p50_s", "late_p99_s", "late_most_s", "together_most", "refused")
        }
        return Flow(
            sent=sent["frames"],
            received=came["frames"],
            others=came["others"],
            garbage=came["garbage"],
            datagrams=came["datagrams"],
            seconds=sent["seconds"],
            arrived=arrived,
            latencies_s=tuple(each / 1e9 for each in came["latencies_ns"]),
            evenness=evenness,
        )

    def count(self) -> int:
        """Frames that came since the last flow began."""
        return int(self._sink.ask("count")["frames"])

    def settle(self, expected: int) -> int:
        """Wait until so many came, or nothing more does; how many did."""
        before, still_since = -1, time.monotonic()
        while (came := self.count()) < expected:
            if came != before:
                before, still_since = came, time.monotonic()
            elif time.monotonic() - still_since > SETTLED_S:
                break
            time.sleep(POLL_S)
        return came
