"""Recordings and metrics of real daemons: the frames on the link, and their figures."""

from __future__ import annotations

from tests.daemon.frames import frame
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from uavlinkd.lab.sim.tlog import read_tlog

FROM_PEER, TO_PEER = 0, 1


def record(daemon: DaemonProcess) -> None:
    """Have it record, on whatever disk there is."""
    daemon.config["recording"] = {"folder": "flights", "min_free_bytes": 100_000}


def recorded(daemon: DaemonProcess) -> list[tuple[int, bytes]]:
    """Which way, and what, of its only file."""
    (path,) = (daemon.folder / "flights").iterdir()
    return [(record.time_us & 3, record.frame) for record in read_tlog(path).records]


async def test_what_crossed_the_link_is_recorded_at_both_ends(stage: Stage) -> None:
    """The same frames, in order, each as it was; of what waited for a link before there was one, nothing."""
    a, b = stage.pair()
    record(a)
    record(b)
    into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    await stage.start(a, linked=False)
    one, other = await stage.client(), await stage.client()
    one.send(frame(99), into_a)
    await a.until(lambda status: status["endpoints"]["autopilot"]["frames_received"] == 1)
    await stage.start(b)
    await a.until_linked()
    for number in range(20):
        one.send(frame(number), into_a)
        await b.until(lambda status, n=number: status["peers"]["drone0"]["frames_received"] == n + 1)  # type: ignore[misc]
    other.send(frame(50, 2), into_b)
    await one.until_received(frame(50, 2))
    await a.until(lambda status: status["recording"]["frames"] == 21)
    await a.stop()
    await b.stop()
    there = [frame(number) for number in range(20)]
    assert recorded(a) == [*((TO_PEER, raw) for raw in there), (FROM_PEER, frame(50, 2))]
    assert recorded(b) == [*((FROM_PEER, raw) for raw in there), (TO_PEER, frame(50, 2))]


async def test_what_a_policy_refuses_is_recorded_as_it_came(stage: Stage) -> None:
    """It crossed the link: of a captured peer one wants to know what it tried."""
    a, b = stage.pair()
    record(b)
    into_a = a.add_endpoint("autopilot")
    b.config["peer"][0] |= {"system_ids": [7], "role": "vehicle"}
    await stage.start(a, b)
    client = await stage.client()
    client.send(frame(1), into_a)
    await b.until(lambda status: bool(status["peers"]["drone0"]["refused"]["in"]))
    await b.until(lambda status: status["recording"]["frames"] == 1)
    await b.stop()
    assert recorded(b) == [(FROM_PEER, frame(1))]
