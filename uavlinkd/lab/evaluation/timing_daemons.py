"""Times handshakes of two real daemons, each a process.

A proxy between the daemons sees each datagram. For a handshake it first drops all of them, until both processes are
idle and the initiator waits for its retry. Then it passes them. The time starts when the next initiation reaches the
proxy. It ends when the responder delivers the first frame, which is sent when the initiator has confirmed. So the
start of the processes (about 0.5 s) is not included, and the computation before the initiation is only in the
initiator's processor time. The proxy adds about 0.2 ms for each of the four datagrams.
"""

from __future__ import annotations

import asyncio
import signal
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from time import monotonic
from typing import Any

from uavlinkd.lab.child_processes import private_folder
from uavlinkd.lab.evaluation.ledger import numbered_frame
from uavlinkd.lab.evaluation.middle import MiddleHere
from uavlinkd.lab.evaluation.records import EvaluationError, Record, Status, Value, cpu_seconds
from uavlinkd.lab.evaluation.stage import DaemonStage, until
from uavlinkd.lab.mitm.attack import Action, Direction, PassiveAttack, Send
from uavlinkd.lab.sim.drone_process import DroneError
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.protocol import wire
from uavlinkd.protocol.suites import Suite

HANDSHAKE_LIMIT_S = 20.0
"""Enough for some retries: a handshake that takes longer has failed."""
_SETTLE_S = 0.01
"""The delay after the frame until both processes are idle, so that their processor time is complete."""
_AGAIN_S = 0.25
_INITIATOR, _RESPONDER = "initiator", "responder"
_ENVELOPES = (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE)


class Watch(PassiveAttack):
    """Passes datagrams while it is open, and counts them by sender."""

    name = "watch"

    def __init__(self) -> None:
        self.is_open = False
        self.dropped = 0
        self.datagrams: Counter[str] = Counter()
        self.bytes: Counter[str] = Counter()
        self.initiated_at: float | None = None
        self.on_confirmed: Callable[[], object] | None = None
        """Called when the initiator's first envelope passes: it confirms the session of both."""

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        if not self.is_open:
            self.dropped += 1
            return []
        self.datagrams[direction.sender] += 1
        self.bytes[direction.sender] += len(datagram)
        if direction.sender == _INITIATOR and datagram[0] == wire.INITIATION:
            self.initiated_at = self.initiated_at or monotonic()
        elif direction.sender == _INITIATOR and datagram[0] in _ENVELOPES and self.on_confirmed:
            asyncio.get_running_loop().call_soon(self.on_confirmed)
            self.on_confirmed = None
        return [Send(datagram, direction)]


class TimedPair(DaemonStage):
    """Two daemons, a client of each, and a proxy between them that drops everything until :attr:`watch` is open."""

    def __init__(self, folder: Path, suite: Suite) -> None:
        names = (_INITIATOR, _RESPONDER)
        super().__init__(names, folder, MiddleHere(names, 0), {"suites": [suite.name]}, rate_hz=0.0)
        self.watch = Watch()
        self.arrived_at: float | None = None
        """When the first frame arrived at the responder's client."""
        self.receive = self._on_received
        self._number = 0
        self._delivered = asyncio.Event()

    def addresses(self, one: str, other: str) -> list[object]:
        """The addresses of the responder; it has none of the initiator."""
        return super().addresses(one, other) if one == _INITIATOR else []

    async def open(self) -> None:
        """Start the proxy, which drops everything, and the daemons. Each has answered, and knows its client."""
        for name in self.names:
            self.configure(name)
        await self.middle.start(*self.attacked())
        await self.middle.attack([], [self.watch])
        self._clients.open(self.names)
        for name, drone in self.drones.items():
            await drone.start()
            await until(drone.ask, f"{name} did not start")
        self.send(_RESPONDER, numbered_frame(2, 0))

    async def close(self) -> None:
        """Kill both daemons: a close message would be traffic."""
        await asyncio.gather(*(drone.stop(signal.SIGKILL) for drone in self.drones.values()))
        await super().close()

    def _on_received(self, name: str, datagram: bytes, now: float) -> None:
        if name == _RESPONDER and split_datagram(datagram, SplitCounters()):
            self.arrived_at = self.arrived_at or now
            self._delivered.set()

    def send_frame(self) -> None:
        """Send a new frame to the initiator's daemon."""
        self._number += 1
        self.send(_INITIATOR, numbered_frame(1, self._number))

    def cpu_s(self) -> dict[str, float]:
        return {f"cpu_{name}_s": cpu_seconds(drone.pid) for name, drone in self.drones.items()}

    def cpu_since(self, before: dict[str, float]) -> dict[str, float]:
        return {name: seconds - before[name] for name, seconds in self.cpu_s().items()}

    async def until_delivered(self, limit_s: float) -> None:
        """Wait for the first frame. A frame that arrives before the initiator has a session is dropped: send others.

        Raises:
            EvaluationError: no frame was delivered in time.
        """
        end = monotonic() + limit_s
        while self.arrived_at is None:
            with suppress(TimeoutError):
                async with asyncio.timeout(_AGAIN_S):
                    await self._delivered.wait()
                    return
            if monotonic() > end:
                raise EvaluationError(f"no frame was delivered within {limit_s:g} s")
            self.send_frame()


async def measured(kind: str, point: dict[str, Value], measure: Awaitable[dict[str, Any]]) -> Record:
    """The record of a measurement, also of one that fails."""
    try:
        return Record(kind, point, await measure)
    except (EvaluationError, DroneError, OSError) as error:
        return Record(kind, point, {}, Status.FAILED, str(error))


async def time_handshake(suite: Suite) -> dict[str, Any]:
    """One handshake between two new processes with new keys."""
    async with AsyncExitStack() as stack:
        pair = TimedPair(stack.enter_context(private_folder("uavlinkd-")), suite)
        stack.push_async_callback(pair.close)
        await pair.open()
        watch = pair.watch

        async def has_initiated() -> bool:
            return watch.dropped > 0

        await until(has_initiated, "the initiator did not send an initiation", HANDSHAKE_LIMIT_S)
        before = pair.cpu_s()
        watch.on_confirmed, watch.is_open = pair.send_frame, True
        await pair.until_delivered(HANDSHAKE_LIMIT_S)
        counts = {name: [getattr(watch, name)[end] for end in pair.drones] for name in ("bytes", "datagrams")}
        await asyncio.sleep(_SETTLE_S)
        assert watch.initiated_at is not None
        assert pair.arrived_at is not None
        return {"total_s": pair.arrived_at - watch.initiated_at, **counts, **pair.cpu_since(before)}
