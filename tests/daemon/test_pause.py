"""A daemon that stood still gives nobody what had gathered meanwhile as if it were new."""

from __future__ import annotations

import asyncio
import signal

import pytest

from tests.daemon.harness import Stage, frame

PAUSED_S = 4.0


@pytest.mark.parametrize("paused", ["sender", "receiver"])
async def test_what_waited_while_a_daemon_was_stopped_is_not_delivered(paused: str, stage: Stage) -> None:
    """After a SIGSTOP of some seconds only what is sent from then on arrives, and the rest is told as stale."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    sink = await stage.program()
    b.add_endpoint("ground", f"udpout:{sink}")
    await stage.start(a, b)
    source = await stage.program()
    source.send(frame(1), into)
    await sink.until_heard(frame(1))

    stopped = a if paused == "sender" else b
    await stopped.send_signal(signal.SIGSTOP)
    for number in range(2, 42):
        source.send(frame(number), into)
        await asyncio.sleep(PAUSED_S / 40)
    await stopped.send_signal(signal.SIGCONT)
    await stopped.until_logged("daemon_stood_still")
    fresh = 100
    while not any(frame(number) in sink.received for number in range(100, fresh)):
        source.send(frame(fresh), into)
        fresh += 1
        await asyncio.sleep(0.05)
        assert fresh < 200

    late = [number for number in range(2, 40) if frame(number) in sink.received]
    assert late == [], "these had waited while the daemon was stopped"
    await stopped.until_logged("frames_dropped", reason="stale")
    assert sum((await stopped.status())["stale"].values()) > 0
