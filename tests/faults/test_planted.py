"""An exception inside a daemon costs one datagram, output, timer or connection, or the process ends; frames that do
not move starve the watchdog."""

from __future__ import annotations

import asyncio
import signal
from itertools import count

import pytest

from tests.faults.manager import WATCHDOG_S, ServiceManager
from tests.faults.planted import PLACES, RUN, measure
from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.udp import Client, Sockaddr
from tests.waiting import until

SAMPLE = list({(place.file, place.stops, place.times > 1): place for place in PLACES}.values())
"""One place of each module, and the places where an exception ends the process."""


@pytest.mark.parametrize("floods", [False, True], ids=["quiet", "flood"])
async def test_fault_costs_only_its_own(floods: bool) -> None:
    """A fault in one link: the others lose no frame, and it is back within 5 s; or the process ends.

    ``python -m tests.faults.planted`` has all places.
    """
    places = SAMPLE[::4] if floods else SAMPLE
    outcomes = await measure(places, floods=floods)
    assert len(outcomes) == len(places)
    assert [outcome.row() for outcome in outcomes if not outcome.is_right] == []


async def test_watchdog_ends_a_daemon_whose_frames_stop_although_its_timers_run() -> None:
    """The loop stops to watch the sockets: housekeeping and requests go on, and no datagram is read."""
    async with Stage() as stage:
        a, b = stage.pair()
        into, ground = a.add_endpoint("autopilot"), await stage.client()
        b.add_endpoint("ground", f"udpout:{ground}")
        manager = ServiceManager(stage.folder / "notify", b)
        b.code, b.is_planted = RUN, True
        b.environ |= manager.environ
        watching = asyncio.create_task(manager.watch())
        try:
            await stage.start(a, b)
            client = await stage.client()
            await asyncio.sleep(WATCHDOG_S + 1.0)
            assert b.is_running, "an idle daemon is fed"
            client.send(frame(1), into)
            await ground.until_received(frame(1))
            await b.ask("deafen")
            talking = asyncio.create_task(_talk(client, into))
            await b.until_logged("work_stuck")
            assert (await b.status())["peers"], "its timers and its control socket work"
            await until(lambda: not b.is_running)
            talking.cancel()
            assert await b.ended() == -signal.SIGABRT
        finally:
            watching.cancel()
            manager.close()


async def _talk(client: Client, into: Sockaddr) -> None:
    for number in count(2):
        client.send(frame(number), into)
        await asyncio.sleep(0.02)
