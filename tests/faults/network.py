"""Faults of the network: each happens to one of two hosts with a cable between them."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from time import monotonic

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.faults.cable import ADDRESSES, PORT, Cable
from tests.faults.talk import Log, Outcome, grew, reported
from tests.waiting import PATIENCE_S
from uavlinkd.link.drop_summary import EVERYDAY

FAULT_S = float(os.environ.get("UAVLINKD_FAULT_S", "4"))
"""How long a fault lasts: longer than a peer may be silent (3 s)."""
_NET = f"{ADDRESSES[0].rpartition('.')[0]}.0/24"

Step = Callable[[Cable], Awaitable[None]]


async def _suffer(stage: Stage, victim: str, begin: Step, end: Step, *names: str) -> Outcome:
    """Break the network of a talking daemon, and mend it. ``names``: of the errors that may be counted."""
    async with Cable(stage, victim) as cable:
        daemon = cable.victim
        before, log = await daemon.status(), Log(daemon)
        await begin(cable)
        await asyncio.sleep(FAULT_S)
        during = await daemon.status()
        failures = grew(before, during, "send_failures")
        assert failures, "the fault did not come about"
        assert set(failures) <= set(names), failures
        state = during["peers"][cable.other.name]["state"]
        await end(cable)
        recovered_s = await cable.talk.back(monotonic())
        cable.talk.check_no_copies()
        await check_reported(daemon, *failures)
        return Outcome(f"sends failed: {reported(failures)}; peer {state}", recovered_s, log.count)


async def check_reported(daemon: DaemonProcess, *names: str) -> None:
    """Each error has a line in the log, under its name; and none more than a line each ten seconds.

    A full buffer is an everyday error: the log has it only if it persists for longer than this fault.
    """
    for name in names:
        if name not in EVERYDAY:
            await daemon.until_logged("sends_failed", reason=name)
        lines = daemon.events("sends_failed", reason=name)
        assert len(lines) <= 2 + FAULT_S / 10, (name, len(lines))


async def interface_down(stage: Stage) -> Outcome:
    """The interface is set down, and up again."""

    async def begin(cable: Cable) -> None:
        await cable.ip("link", "set", "eth0", "down")

    async def end(cable: Cable) -> None:
        await cable.ip("link", "set", "eth0", "up")

    return await _suffer(stage, "drone0", begin, end, "ENETUNREACH", "EINVAL")


async def interface_gone(stage: Stage) -> Outcome:
    """The interface is deleted with its address, and another is made."""

    async def begin(cable: Cable) -> None:
        await cable.ip("link", "delete", "eth0")

    async def end(cable: Cable) -> None:
        await cable.plug_in()
        await cable.configure()

    return await _suffer(stage, "drone1", begin, end, "ENETUNREACH", "EINVAL")


async def route_gone(stage: Stage) -> Outcome:
    """No route leads to the peer: the network is unreachable."""

    async def begin(cable: Cable) -> None:
        await cable.ip("route", "delete", _NET, "dev", "eth0")

    async def end(cable: Cable) -> None:
        await cable.ip("route", "add", _NET, "dev", "eth0")

    return await _suffer(stage, "drone0", begin, end, "ENETUNREACH")


async def route_prohibited(stage: Stage) -> Outcome:
    """An administrator prohibits the way to the peer."""

    async def begin(cable: Cable) -> None:
        await cable.ip("route", "add", "prohibit", ADDRESSES[1])

    async def end(cable: Cable) -> None:
        await cable.ip("route", "delete", "prohibit", ADDRESSES[1])

    return await _suffer(stage, "drone1", begin, end, "EACCES")


async def firewall(stage: Stage) -> Outcome:
    """A firewall forbids sending to the peers' port."""

    async def begin(cable: Cable) -> None:
        await cable.say("nft", "add table inet fault")
        await cable.say("nft", "add chain inet fault out { type filter hook output priority 0 ; }")
        await cable.say("nft", f"add rule inet fault out udp dport {PORT} drop")

    async def end(cable: Cable) -> None:
        await cable.say("nft", "delete table inet fault")

    return await _suffer(stage, "drone0", begin, end, "EPERM")


async def buffers_full(stage: Stage) -> Outcome:
    """The interface sends next to nothing, and the socket's buffer is full of what waits for it."""

    async def begin(cable: Cable) -> None:
        await cable.say(
            *("tc", "qdisc", "add", "dev", "eth0", "root", "tbf", "rate", "8kbit", "burst", "2000", "limit", "50m")
        )
        loop = asyncio.get_running_loop()
        deadline = loop.time() + PATIENCE_S
        while not (await cable.victim.status())["send_failures"]:
            assert loop.time() < deadline, "a buffer without end"
            for _ in range(200):
                cable.talk.voices[0].shout()
            await asyncio.sleep(0.01)

    async def end(cable: Cable) -> None:
        await cable.say("tc", "qdisc", "delete", "dev", "eth0", "root")

    return await _suffer(stage, "drone1", begin, end, "EAGAIN", "ENOBUFS")
