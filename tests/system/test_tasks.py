"""Background tasks, and worker threads for calls that may hang."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from typing import Any

import pytest

from uavlinkd.system import tasks
from uavlinkd.system.tasks import Threads, keep_running


async def test_failure_is_reported_at_once_and_the_work_begins_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The report does not wait for the end of the process, and what depends on the task works again."""
    monkeypatch.setattr(tasks, "RESTART_S", 0.0)
    reports: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context))
    begun, third = 0, asyncio.Event()

    async def fail_twice() -> None:
        nonlocal begun
        begun += 1
        if begun < 3:
            raise ZeroDivisionError
        third.set()

    await keep_running(fail_twice, "the search for drone1")
    assert third.is_set()
    assert [type(report["exception"]) for report in reports] == [ZeroDivisionError] * 2


async def test_cancelled_run_does_not_wait_for_a_hanging_call() -> None:
    """The call keeps its thread, and its late result is ignored."""
    some = Threads(1, "test-gone")
    gate, asked = threading.Event(), threading.Event()

    def work() -> None:
        asked.set()
        gate.wait()

    task = asyncio.create_task(some.run(work))
    await asyncio.to_thread(asked.wait)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    later = asyncio.create_task(some.run(int, "7"))
    await asyncio.sleep(0)
    assert not later.done()
    gate.set()
    assert await later == 7


def test_process_exit_does_not_wait_for_threads() -> None:
    """A hanging call does not delay the end of the process."""
    code = (
        "import asyncio, time\n"
        "from uavlinkd.system.tasks import Threads\n"
        "async def work():\n"
        "    asyncio.ensure_future(Threads(1, 'x').run(time.sleep, 600))\n"
        "    await asyncio.sleep(0.05)\n"
        "asyncio.run(work())\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=240, check=False).returncode == 0


async def test_call_fails_while_no_thread_can_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """`run` raises OSError, and a later call can start a thread again."""
    some = Threads(1, "test-none")

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        with pytest.raises(BlockingIOError):  # which is EAGAIN
            await some.run(int)
    assert await some.run(divmod, 7, 2) == (3, 1)
