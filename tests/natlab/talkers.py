"""Clients that send numbered frames at steady rates, and how old the frames arrive."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from time import monotonic
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.processes.frames import command_long, frames_in
from tests.processes.udp import Sockaddr
from tests.samples import pack

COMMAND, TELEMETRY = "command", "telemetry"
FLOWS: Final = 25
"""Telemetry comes from so many components: newer states replace older ones of the same component."""
TICK_S: Final = 0.01

Rates = Mapping[str, int]
"""Frames a second of each kind."""


@dataclass(frozen=True, slots=True)
class Ages:
    """Of the frames of one kind from one end. Seconds."""

    sent: int
    arrived: tuple[float, ...]
    """The age of each that arrived, the least first."""
    gap_s: float
    """The longest time between two that arrived."""

    def share(self, part: float) -> float:
        return (
            self.arrived[min(len(self.arrived) - 1, int(part * len(self.arrived)))] if self.arrived else float("inf")
        )

    @property
    def lost(self) -> int:
        return self.sent - len(self.arrived)


class Talker:
    """One client. It sends frames of each kind at a steady rate, and notes when those of the other one arrive."""

    def __init__(self, sock: socket.socket, into: Sockaddr, system: int, rates: Rates) -> None:
        self.sent: dict[bytes, tuple[str, float]] = {}
        self.received: dict[bytes, float] = {}
        self._sock, self._into, self._system, self._rates = sock, into, system, rates

    async def talk(self) -> None:
        """Without end."""
        loop, counts, began = asyncio.get_running_loop(), dict.fromkeys(self._rates, 0), monotonic()
        loop.add_reader(self._sock, self._on_readable)
        try:
            while True:
                for kind, rate in self._rates.items():
                    while counts[kind] < (monotonic() - began) * rate:
                        raw = _frame(kind, counts[kind], self._system)
                        counts[kind] += 1
                        self.sent[raw] = kind, monotonic()
                        self._sock.sendto(raw, self._into)
                await asyncio.sleep(TICK_S)
        finally:
            loop.remove_reader(self._sock)
            self._sock.close()

    def _on_readable(self) -> None:
        now = monotonic()
        with suppress(BlockingIOError):
            while True:
                for raw in frames_in(self._sock.recv(65536)):
                    self.received.setdefault(raw, now)


def _frame(kind: str, number: int, system: int) -> bytes:
    """40 bytes and a bit."""
    if kind == COMMAND:
        return command_long(number % 60_000, system, (3 - system, 1), seq=number, param1=float(number))
    position = mavlink.MAVLink_global_position_int_message(number, 473977420, 85455940, 488000, 3000, 1, 1, 1, 1)
    return pack(position, system, 1 + number % FLOWS, seq=number // FLOWS)


def ages(sender: Talker, receiver: Talker, kind: str, since: float, before: float) -> Ages:
    """Of the frames that were sent in between."""
    sent = {raw: at for raw, (of, at) in sender.sent.items() if of == kind and since <= at < before}
    times = sorted(at for raw, at in receiver.received.items() if sender.sent.get(raw, ("",))[0] == kind)
    times = [since, *(at for at in times if since < at < before), before]
    arrived = sorted(receiver.received[raw] - at for raw, at in sent.items() if raw in receiver.received)
    return Ages(len(sent), tuple(arrived), max(after - at for at, after in pairwise(times)))
