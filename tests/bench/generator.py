"""Sends frames at an even rate, or when the vehicle sent them: a process of its own, whose work is not counted.

It reads an order a line (JSON) from standard input, and answers each with a line: how many frames were sent, in what
time, and how evenly. Each datagram has its own deadline on the monotonic clock; one whose deadline passed is sent at
once, so what is ever sent in one go is what was overdue.
"""

from __future__ import annotations

import ctypes
import json
import os
import socket
import sys
import time
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, NamedTuple

from tests.bench.frames import is_probe, read_frames, stamp
from tests.bench.traffic import AS_RECORDED

PR_SET_TIMERSLACK: Final = 29
"""Of prctl(2): by how much the kernel may let a sleep last longer. the default is 50 us."""
BUFFER_BYTES: Final = 1 << 20
START_NS: Final = 1_000_000
"""The first deadline is so far off."""


class Datagram(NamedTuple):
    """Frames that are sent together, and where those of them begin that carry the time."""

    data: bytearray
    probes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Sent:
    """What was sent. Times in seconds."""

    frames: int
    refused: int
    """Datagrams that the kernel did not take; counted in ``frames`` too: they were offered."""
    seconds: float
    late_p50_s: float
    """How late a datagram was: the middle one, the 99th of a hundred, the latest."""
    late_p99_s: float
    late_most_s: float
    together_most: int
    """Most datagrams that were sent in one go, as they were overdue."""


def pack(frames: Sequence[bytes], per_datagram: int) -> list[Datagram]:
    """These frames in datagrams of so many; what is over at the end is left out."""
    datagrams = []
    for start in range(0, len(frames) - per_datagram + 1, per_datagram):
        data, probes = bytearray(), list[int]()
        for frame in frames[start : start + per_datagram]:
            if is_probe(frame):
                probes.append(len(data))
            data += frame
        datagrams.append(Datagram(data, tuple(probes)))
    return datagrams


class Pace:
    """Deadlines of datagrams, and how well they were kept. ``due_ns``: those, from the beginning on."""

    def __init__(self, due_ns: Callable[[int], int]) -> None:
        self._due_ns = due_ns
        self._began_ns = time.monotonic_ns() + START_NS
        self._late_ns: list[int] = []
        self._together = self._together_most = 0

    def wait(self, number: int) -> None:
        """Until the deadline of the datagram of this number; not at all where it has passed."""
        due = self._began_ns + self._due_ns(number)
        now = time.monotonic_ns()
        if now < due:
            time.sleep((due - now) / 1e9)
            now = time.monotonic_ns()
            self._together = 0
        self._together += 1
        self._together_most = max(self._together_most, self._together)
        self._late_ns.append(now - due)

    def sent(self, frames: int, refused: int = 0) -> Sent:
        """The result, when the last was sent."""
        took = (time.monotonic_ns() - self._began_ns) / 1e9
        late = sorted(self._late_ns)
        p50, p99, most = (late[min(len(late) - 1, int(part * len(late)))] / 1e9 for part in (0.5, 0.99, 1.0))
        return Sent(frames, refused, took, p50, p99, most, self._together_most)


def send_all(
    sock: socket.socket, datagrams: Sequence[Datagram], count: int, pace: Pace, per_datagram: int = 1
) -> Sent:
    """Send so many of these datagrams, over and over, to where the socket is connected."""
    wait, send, size = pace.wait, sock.send, len(datagrams)
    refused = 0
    for number in range(count):
        wait(number)
        data, probes = datagrams[number % size]
        for offset in probes:
            stamp(data, offset, time.monotonic_ns())
        try:
            send(data)
        except OSError:  # a full queue, or a tunnel that is not up: it shows as loss
            refused += 1
    return pace.sent(count * per_datagram, refused)


def main() -> None:
    """``generator FILE``: the frames; orders are ``{"host", "port", "rate", "seconds", "per_datagram"}``."""
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    # Before all that is measured, and all else: late frames would come in bursts, which are cheaper than even ones.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    frames, times_s = read_frames(Path(sys.argv[1]))
    packed: dict[int, list[Datagram]] = {}
    socks: dict[tuple[str, int], socket.socket] = {}
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        per_datagram, target = order["per_datagram"], (order["host"], order["port"])
        if per_datagram not in packed:
            packed[per_datagram] = pack(frames, per_datagram)
        if target not in socks:
            sock = socks[target] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
            sock.connect(target)
        if order["rate"] == AS_RECORDED:
            pace = Pace(lambda number: int(times_s[number] * 1e9))
            count = bisect_left(times_s, order["seconds"])
        else:
            interval_ns = 1e9 * per_datagram / order["rate"]
            pace = Pace(lambda number: int(number * interval_ns))  # noqa: B023  it is used in this turn of the loop
            count = max(1, round(order["seconds"] * 1e9 / interval_ns))
        sent = send_all(socks[target], packed[per_datagram], count, pace, per_datagram)
        print(json.dumps(asdict(sent)), flush=True)


if __name__ == "__main__":
    main()
