"""A recorded flight that goes into one daemon comes out of the other byte for byte."""

from __future__ import annotations

from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.processes.harness import Stage
from tests.processes.process import Status
from tests.processes.udp import pour
from tests.tlog import read_tlog

FLIGHTS = {
    # MAVLink 2, a simulated copter.
    "arducopter_sitl_flight.tlog": frozenset[int](),
    # MAVLink 2, a real submarine. The checksums of four of its frames fit nothing: they were recorded broken.
    "ardusub_dive.tlog": frozenset({317, 485, 1733, 1887}),
    # MAVLink 1, a real copter; 1,314 frames of a message that the dialect defines otherwise. Its last entry is cut.
    "copter_flight_mavlink1.tlog": frozenset[int](),
}
MODES: dict[str, dict[str, Any]] = {
    "tag-of-8": {"tag_bits": 64},
    "tag-of-16": {"tag_bits": 128},
    "confidential": {"confidential": True},
}


@cache
def recorded(path: Path) -> list[bytes]:
    return [record.frame for record in read_tlog(path)]


def drops(status: Status) -> Counter[str]:
    """What a daemon discarded, without answers that were no longer waited for: both may initiate at once."""
    counts = sum((Counter(peer["drops"]) for peer in status["peers"].values()), start=Counter(status["drops"]))
    del counts["unexpected_response"]
    return counts


async def fly(stage: Stage, frames: list[bytes], lost: frozenset[int], **link: Any) -> None:
    """Play frames into one daemon and compare what comes out of the other."""
    a, b, into, ground = await stage.one_way(**link)
    # While a slow machine starts daemons, initiations may be repeated too often.
    before = [drops(await daemon.status()) for daemon in (a, b)]
    await pour(frames, await stage.client(), into, ground, lost=lost)
    after = [await a.status(), await b.status()]
    assert [drops(status) for status in after] == before
    assert [status["send_failures"] for status in after] == [{}, {}]
    session = next(iter((await b.status())["peers"].values()))["session"]
    assert session["mode"] == ("confidential" if link.get("confidential") else "authenticated")
    assert session["tag_bits"] == link.get("tag_bits", 128)
    assert session["suite"] == link.get("suites", ["x25519"])[0]
    assert session["lost_in"] == 0
    bad = (await a.status())["endpoints"]["autopilot"]["faults"]
    assert bad == ({"bad_crc": len(lost)} if lost else {})


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("arducopter_sitl_flight.tlog", "tag-of-16"),
        ("ardusub_dive.tlog", "confidential"),
        ("copter_flight_mavlink1.tlog", "tag-of-8"),
    ],
)
async def test_a_whole_flight_crosses(stage: Stage, shared_data: Path, name: str, mode: str) -> None:
    """Every genuine frame of both MAVLink versions arrives unaltered and in its place, and nothing else does."""
    await fly(stage, recorded(shared_data / name), FLIGHTS[name], **MODES[mode])
