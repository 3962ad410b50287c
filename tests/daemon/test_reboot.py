"""A daemon that loses power and wakes up with no state and a clock that is decades off is back at once."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.daemon.harness import Program, Sockaddr, Stage, frame, need

BACK_WITHIN_S = 2.0


def faked_clock(at: str) -> dict[str, str]:
    """The environment in which a process believes that it is another time; its monotonic clock is genuine."""
    folders = [Path("/usr/lib"), Path("/usr/lib64"), Path("/usr/local/lib")]
    libraries = [each for folder in folders for each in sorted(folder.glob("**/faketime/libfaketime.so.1"))]
    need(bool(libraries), "libfaketime (Debian: faketime)")
    return {
        "LD_PRELOAD": str(libraries[0]),
        "FAKETIME": f"@{at}",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "TZ": "UTC",
    }


# The second passes 2**32 seconds after the epoch while the test runs.
@pytest.mark.parametrize("at", ["1970-01-01 00:00:00", "2106-02-07 06:28:14"])
async def test_a_rebooted_daemon_is_back_whatever_its_clock_says(stage: Stage, at: str) -> None:
    """Killed and started again in 1970 or 2106, a daemon carries frames both ways within two seconds."""
    environ = faked_clock(at)
    a, b = stage.pair()
    into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    await stage.start(a, b)
    one, other = await stage.program(), await stage.program()
    async with asyncio.TaskGroup() as tasks:
        traffic = [tasks.create_task(talk(one, into_a, 1)), tasks.create_task(talk(other, into_b, 2))]
        await one.until(lambda: bool(one.received))
        await other.until(lambda: bool(other.received))
        await b.kill()
        before = len(b.lines)
        await b.start(environ)
        await b.ready()
        one.clear()
        other.clear()
        async with asyncio.timeout(BACK_WITHIN_S):
            await one.until(lambda: bool(one.received))
            await other.until(lambda: bool(other.received))
        for task in traffic:
            task.cancel()
    started = await b.until_logged("daemon_started")
    assert b.lines.index(next(line for line in b.lines[before:] if "daemon_started" in line)) >= before
    assert started["timestamp"].startswith(at[:10]), "the clock was not faked"
    assert a.events("session_established")[-1]["rekey"], "the living side kept its session until there was a new one"


async def talk(program: Program, into: Sockaddr, system: int) -> None:
    """Send frames as an autopilot does, without end."""
    number = 0
    while True:
        number += 1
        program.send(frame(number, system), into)
        await asyncio.sleep(0.02)
