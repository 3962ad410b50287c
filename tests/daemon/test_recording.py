"""The recording of a real daemon."""

from __future__ import annotations

from tests.daemon.frames import frame
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from uavlinkd.lab.sim.tlog import read_tlog

FROM_PEER = 0


def recorded(daemon: DaemonProcess) -> list[tuple[int, bytes]]:
    """Which way, and what, of its only file."""
    (path,) = (daemon.folder / "flights").iterdir()
    return [(record.time_us & 3, record.frame) for record in read_tlog(path).records]


async def test_what_a_policy_refuses_is_recorded_as_it_came(stage: Stage) -> None:
    """It crossed the link: of a captured peer one wants to know what it tried."""
    a, b = stage.pair()
    b.config["recording"] = {"folder": "flights", "min_free_bytes": 100_000}
    into_a = a.add_endpoint("autopilot")
    b.config["peer"][0] |= {"system_ids": [7], "role": "vehicle"}
    await stage.start(a, b)
    client = await stage.client()
    client.send(frame(1), into_a)
    await b.until(lambda status: bool(status["peers"]["drone0"]["refused"]["in"]))
    await b.until(lambda status: status["recording"]["frames"] == 1)
    await b.stop()
    assert recorded(b) == [(FROM_PEER, frame(1))]
