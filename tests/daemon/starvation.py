"""Measures what an operator gets through a real daemon's serial port while a captured swarm member floods it.

::

    python -m tests.daemon.starvation
"""

from __future__ import annotations

import asyncio
import io
from collections.abc import Mapping
from contextlib import AsyncExitStack, redirect_stdout
from time import monotonic

from tests.daemon.fleet import AN_OPERATOR, Rogue, a_member
from tests.daemon.harness import Stage
from tests.daemon.losses import lost_to_waiting
from tests.daemon.paced_line import Line
from tests.daemon.process import DaemonProcess
from tests.endpoints.starvation import (
    BAUD,
    CAPTURED,
    COMMANDS,
    HEADING,
    HEARTBEATS,
    RATES_KBIT_S,
    Result,
    command,
    heartbeat,
    position,
    row,
    summary,
)
from tests.limited_cpu import limited_cpu, why_no_limit
from uavlinkd.lab.sim.loopback_ports import free_port

DURATION_S = 10.0
FRAMES_PER_ENVELOPE = 20
SHARE = 0.2
LIFTED: Mapping[str, object] = {"rate_in": {"position": 100_000}}
"""Takes the role's own limit away: the queue alone has to do."""
POLICIES: Mapping[str, Mapping[str, object]] = {"the role's own rates": {}, "without those rates": LIFTED}


class PacedDaemon(DaemonProcess):
    """A daemon whose serial ports have a line rate."""

    def _executable(self) -> tuple[str, str]:
        return ("-m", "tests.daemon.paced_line")


async def starve(
    stage: Stage,
    kbit_s: float,
    policy: Mapping[str, object],
    *,
    cpu_share: float | None = None,
    duration_s: float = DURATION_S,
) -> Result:
    """Flood a daemon's serial port through a link, beside an operator at another link.

    ``policy``: what the daemon's configuration says of the captured member besides its role.
    """
    size = len(position(0))
    per_s = kbit_s * 1000 / 8 / size
    flood = [position(number) for number in range(int(per_s * duration_s))]
    victim = PacedDaemon("victim", stage.folder / "victim", [f"127.0.0.1:{free_port()}"])
    stage.daemons.append(victim)
    line = Line(stage.folder / "uart", BAUD)
    victim.add_endpoint("autopilot", line.url)
    psks = {}
    for name, role in (("captured", {**a_member(CAPTURED), **policy}), ("operator", AN_OPERATOR)):
        peer = stage.daemon(name)
        psks[name] = stage.psk()
        victim.add_peer(peer, [], psks[name], **role)
    captured, operator = stage.daemons[-2:]
    sent_at: dict[bytes, float] = {}
    async with AsyncExitStack() as stack:
        stack.enter_context(line.plugged_in())
        if cpu_share is not None:
            victim.launcher = stack.enter_context(limited_cpu(cpu_share)).launcher
        await victim.start()
        await victim.until(lambda status: bool(status["endpoints"]["autopilot"]["clients"]))
        rogue = await stack.enter_async_context(Rogue(captured, victim, psks["captured"]))
        boss = await stack.enter_async_context(Rogue(operator, victim, psks["operator"]))

        def say(raw: bytes) -> None:
            sent_at[raw] = monotonic()
            boss.say(raw)

        loop = asyncio.get_running_loop()
        began = loop.time()
        for number in range(COMMANDS):
            loop.call_at(began + (number + 0.37) * duration_s / COMMANDS, say, command(number))
        for number in range(HEARTBEATS):
            loop.call_at(began + (number + 0.51) * duration_s / HEARTBEATS, say, heartbeat(number))
        for first in range(0, len(flood), FRAMES_PER_ENVELOPE):
            envelope = flood[first : first + FRAMES_PER_ENVELOPE]
            sent_at.update(dict.fromkeys(envelope, monotonic()))
            rogue.say(b"".join(envelope))
            await asyncio.sleep(began + (first + FRAMES_PER_ENVELOPE) / per_s - loop.time())
        await asyncio.sleep(began + duration_s + 1.5 - loop.time())
        lost = await lost_to_waiting(victim, operator)
        assert await victim.stop() == 0
    return summary(line.arrivals, sent_at, line.bytes_s, 0)._replace(lost_to_waiting=lost)


async def measure() -> None:
    """Print a table for each setting."""
    shares: list[float | None] = [None] if why_no_limit() else [None, SHARE]
    for cpu_share in shares:
        for name, policy in POLICIES.items():
            cpu = "all of a core" if cpu_share is None else f"{cpu_share:g} of a core"
            print(f"GLOBAL_POSITION_INT, {name}, {cpu}", HEADING, sep="\n")
            for kbit_s in RATES_KBIT_S[1:]:
                with redirect_stdout(io.StringIO()):  # the daemon's log
                    async with Stage() as stage:
                        result = await starve(stage, kbit_s, policy, cpu_share=cpu_share)
                print(row(kbit_s, result), flush=True)


if __name__ == "__main__":
    asyncio.run(measure())
