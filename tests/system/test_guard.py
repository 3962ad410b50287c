"""The guard of a process: what a fault of ours costs."""

from __future__ import annotations

import asyncio
from math import inf
from typing import Any, cast

import pytest
from structlog.typing import FilteringBoundLogger

from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.system import guard as module
from uavlinkd.system.guard import EXIT_STATUS, MOST_FAULTS, WITHIN_S, FaultGuard, report, run

PLACE = "mavlink.frames.find_frames"


class Scene:
    """A guard of the running loop, on a clock of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        self.logged: list[str] = []
        self.ended: list[int] = []
        self.of_the_loop: list[object] = []
        monkeypatch.setattr(module, "monotonic", lambda: self.now)
        loop = asyncio.get_running_loop()
        self.guard = FaultGuard(
            cast("FilteringBoundLogger", self), lambda _, context: self.of_the_loop.append(context), self.ended.append
        )
        loop.set_exception_handler(self.guard.on_failure)

    def error(self, event: str, **facts: Any) -> None:
        """Of the log."""
        self.logged.append(f"{event} {facts['place']} {facts['count']}")

    def critical(self, event: str, **facts: Any) -> None:
        """Of the log."""
        self.logged.append(event)


def fail() -> None:
    """A callback that fails in the package."""
    split_datagram(cast("bytes", None), SplitCounters())


async def test_callback_that_fails_often_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is counted, logged once a minute, and the fifth time within a minute is the last."""
    scene, loop = Scene(monkeypatch), asyncio.get_running_loop()
    for _ in range(MOST_FAULTS - 1):
        loop.call_soon(fail)
        await asyncio.sleep(0)
    assert scene.logged == [f"fault_caught {PLACE} 1"]
    scene.now += WITHIN_S + 0.1
    loop.call_later(0.0, fail)
    await asyncio.sleep(0.01)
    assert scene.logged[1:] == [f"fault_caught {PLACE} {MOST_FAULTS}"]
    assert scene.guard.faults == {PLACE: MOST_FAULTS}
    assert scene.ended == []
    for _ in range(MOST_FAULTS - 1):
        run(fail)
    assert scene.logged[2:] == [f"fault_caught {PLACE} {2 * MOST_FAULTS - 1}", "daemon_ended_by_faults"]
    assert scene.ended == [EXIT_STATUS]


async def test_fault_of_an_answer_ends_nothing_and_damaged_state_ends_it_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What only reports may fail as often as it is asked."""
    scene = Scene(monkeypatch)
    for _ in range(2 * MOST_FAULTS):
        run(fail, most=inf)
    assert scene.ended == []
    with pytest.raises(TypeError) as caught:
        fail()
    report(caught.value, most=1)
    assert scene.ended == [EXIT_STATUS]


async def test_error_of_the_loop_itself_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """No function of the package raised it: such as a connection that could not be accepted."""
    scene = Scene(monkeypatch)
    context = {"message": "accept() failed", "exception": OSError(24, "full")}
    asyncio.get_running_loop().call_exception_handler(context)
    assert len(scene.of_the_loop) == 1
    assert not scene.guard.faults
