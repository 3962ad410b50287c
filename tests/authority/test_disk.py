"""The file of a fleet member, written in a thread."""

from __future__ import annotations

import asyncio
from pathlib import Path

from tests.waiting import until
from uavlinkd.authority import state_file
from uavlinkd.authority.state_file import FleetDisk, FleetState
from uavlinkd.system.clock import monotonic

FIRST, SECOND = FleetState(b"first"), FleetState(b"second")


async def test_fault_costs_one_write(tmp_path: Path) -> None:
    """What fails after a write is reported, and a later state is written."""
    reports: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context["exception"]))
    states, written = [FIRST], list[FleetState]()

    def fail_once(state: FleetState) -> None:
        if not reports:
            raise ZeroDivisionError
        written.append(state)

    disk = FleetDisk(tmp_path / "state", lambda: states[-1], fail_once)
    disk.write()
    await until(lambda: bool(reports))
    assert "ZeroDivisionError, a fault inside" in disk.problem
    assert disk.again_at > monotonic()
    states.append(SECOND)
    disk.write()
    await until(lambda: written == [SECOND])
    assert disk.problem == ""


async def test_end_of_the_daemon_waits_for_a_write(tmp_path: Path) -> None:
    """A bulletin that counts already is on the disk when the process ends."""
    disk = FleetDisk(tmp_path / "state", lambda: FIRST, lambda _: None)
    disk.write()
    await disk.stop()
    state_file.write(tmp_path / "expected", FIRST)
    assert (tmp_path / "state").read_bytes() == (tmp_path / "expected").read_bytes()
