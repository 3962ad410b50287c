"""New keys under full traffic, between real daemons."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from tests.daemon.harness import DaemonProcess, Program, Sockaddr, Stage, assert_same, drops, frame

REKEYS = 4
MANY_PER_S = 2000
BURST = 20
ON_THEIR_WAY = 300


async def test_rekeying_at_full_traffic_loses_and_reorders_nothing(stage: Stage) -> None:
    """Thousands of frames a second each way, new keys each second: all arrive once, unaltered, in order."""
    a, b = stage.pair(rekey_after_s=1.0, reject_after_s=5.0)
    into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    await stage.start(a, b)
    one, other = await stage.program(), await stage.program()
    # Each side must have spoken before the other's frames have somewhere to go.
    one.send(frame(0, 1), into_a)
    await a.until(lambda status: bool(status["endpoints"]["autopilot"]["programs"]))
    other.send(frame(0, 2), into_b)
    await one.until_heard(frame(0, 2))
    one.clear()
    other.clear()

    done = asyncio.Event()
    started_at = asyncio.get_running_loop().time()
    async with asyncio.TaskGroup() as tasks:
        there = tasks.create_task(talk(one, into_a, 1, other, done))
        back = tasks.create_task(talk(other, into_b, 2, one, done))
        await asyncio.gather(rekeyed(a), rekeyed(b))
        done.set()
    seconds = asyncio.get_running_loop().time() - started_at

    for sent in (there.result(), back.result()):
        assert sent / seconds > MANY_PER_S, f"that was no full traffic: {sent / seconds:.0f} frames a second"
    for daemon in (a, b):
        status = await daemon.status()
        assert drops(status) == status["send_failures"] == {}
        assert len(daemon.events("session_established", rekey=True)) >= REKEYS
        assert not daemon.events("peer_lost")


async def rekeyed(daemon: DaemonProcess) -> None:
    """Wait until so many new keys have come."""
    first = next(iter((await daemon.status())["peers"].values()))["session"]["generation"]
    await daemon.until(
        lambda status: next(iter(status["peers"].values()))["session"]["generation"] >= first + REKEYS, 30
    )


async def talk(source: Program, into: Sockaddr, system: int, sink: Program, done: asyncio.Event) -> int:
    """Send numbered frames as fast as they come out of the other end; how many, when all have come as sent."""
    expected = bytearray()
    number = 0
    while not done.is_set():
        for _ in range(BURST):
            number += 1
            each = frame(number, system)
            expected += each
            source.send(each, into)
        allowed = len(expected) - ON_THEIR_WAY * len(frame(number, system))
        await sink.until(lambda: len(sink.received) >= allowed)  # noqa: B023  awaited in its turn of the loop
        await asyncio.sleep(0)
    with suppress(TimeoutError):  # the comparison tells what is missing
        await sink.until(lambda: len(sink.received) >= len(expected))
    assert_same(sink.received, bytes(expected))
    return number
