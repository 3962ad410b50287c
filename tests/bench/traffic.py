"""The generator and the sink, as seen from the bench: one order, one flow, and its result."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.bench.cable import Host

REPOSITORY: Final = Path(__file__).parents[2]
SINK_PORT: Final = 14600
AS_RECORDED: Final = 0.0
"""In place of a rate: each frame when the vehicle sent it."""
SETTLED_S: Final = 0.25
"""After this time without a frame, the flow has ended."""
POLL_S: Final = 0.03


class TrafficError(Exception):
    """The generator or the sink has ended. The message is for a person."""


@dataclass(frozen=True, slots=True)
class Flow:
    """What was sent and received. Times in seconds."""

    sent: int
    received: int
    others: int
    garbage: int
    datagrams: int
    """Datagrams with these frames."""
    seconds: float
    arrived: int
    """Frames received when the last one was sent."""
    latencies_s: tuple[float, ...]
    evenness: dict[str, float]
    """The generator's lateness, and the most datagrams that it sent at once."""

    @property
    def loss(self) -> float:
        """The share of frames that were lost; duplicates make it negative."""
        return 1 - self.received / self.sent

    @property
    def behind_s(self) -> float:
        """How long the last frames waited in buffers, at the rate of sending."""
        return (self.received - self.arrived) / self.rate

    def is_even(self, late_s: float) -> bool:
        """Whether the generator sent 99 of 100 datagrams no later than this."""
        return self.evenness.get("late_p99_s", 0.0) <= late_s

    @property
    def rate(self) -> float:
        """The real rate of sending, in frames a second."""
        return self.sent / self.seconds


class Worker:
    """A process of the bench that answers each line with a line of JSON."""

    def __init__(self, host: Host, module: str, *arguments: str) -> None:
        command = [sys.executable, "-m", f"tests.bench.{module}", *arguments]
        self.process: subprocess.Popen[bytes] = host.start(command, folder=REPOSITORY, pipes=True)
        self._name = module
        self.answer()

    def ask(self, line: str) -> dict[str, Any]:
        """The answer to a line. Raises TrafficError if it has ended."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(line.encode() + b"\n")
            self.process.stdin.flush()
        except OSError as error:
            raise TrafficError(f"the {self._name} has ended: {error}") from None
        return self.answer()

    def answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.process.wait()
            raise TrafficError(f"the {self._name} has ended with status {self.process.returncode}")
        answer: dict[str, Any] = json.loads(line)
        return answer


class Traffic:
    """A sender on the left, and a sink on the right."""

    def __init__(self, sender: Worker, sink: Worker) -> None:
        self._sender = sender
        self._sink = sink
        self.processes = (sink.process, sender.process)
        """Processes of the bench, not of a contender."""

    def flow(self, target: tuple[str, int], rate: float, seconds: float, per_datagram: int = 1) -> Flow:
        """Send so many frames a second to this address; ends when all have arrived, or no more arrive."""
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
            latencies_s=tuple(latency / 1e9 for latency in came["latencies_ns"]),
            evenness=evenness,
        )

    def count(self) -> int:
        """Frames received since the last flow began."""
        return int(self._sink.ask("count")["frames"])

    def settle(self, expected: int) -> int:
        """Wait until so many frames have arrived, or no more arrive; returns their number."""
        before, still_since = -1, time.monotonic()
        while (came := self.count()) < expected:
            if came != before:
                before, still_since = came, time.monotonic()
            elif time.monotonic() - still_since > SETTLED_S:
                break
            time.sleep(POLL_S)
        return came
