"""Worker threads for calls that may hang."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue

import pytest

from tests.waiting import PATIENCE_S, until
from uavlinkd.system import threads
from uavlinkd.system.threads import Threads


async def test_results_and_exceptions_are_returned() -> None:
    """`run` behaves like a direct call."""
    some = Threads(2, "test")
    assert await some.run(divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        await some.run(divmod, 7, 0)


async def test_calls_beyond_the_limit_wait_for_a_thread() -> None:
    """A thread runs the waiting calls one after the other."""
    some = Threads(2, "test-most")
    gate, running = threading.Semaphore(0), threading.Semaphore(0)

    def work(number: int) -> tuple[int, str]:
        running.release()
        gate.acquire()
        return number, threading.current_thread().name

    tasks = [asyncio.create_task(some.run(work, number)) for number in range(6)]
    for _ in range(2):
        await asyncio.to_thread(running.acquire)
    assert not running.acquire(blocking=False)
    assert sum(thread.name == "test-most" for thread in threading.enumerate()) == 2
    for _ in tasks:
        gate.release()
    assert sorted(await asyncio.gather(*tasks)) == [(number, "test-most") for number in range(6)]


async def test_idle_threads_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """New work starts new threads."""
    monkeypatch.setattr(threads, "IDLE_S", 0.01)
    some = Threads(3, "test-idle")
    for _ in range(3):
        await some.run(int)
        await until(lambda: all(thread.name != "test-idle" for thread in threading.enumerate()))


async def test_work_is_done_if_it_arrives_while_a_thread_becomes_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread without work counts as idle before more work can arrive, so no work waits for a thread that ended."""
    monkeypatch.setattr(threads, "IDLE_S", 0.01)
    found_none, has_come = threading.Event(), threading.Event()

    class Queue(SimpleQueue[Callable[[], None]]):
        def get_nowait(self) -> Callable[[], None]:
            try:
                return super().get_nowait()
            except Empty:
                found_none.set()
                has_come.wait(0.2)  # it comes in this time, unless it has to wait as well
                raise

    monkeypatch.setattr(threads, "SimpleQueue", Queue)
    some = Threads(1, "test-between")
    await some.run(int)
    await asyncio.to_thread(found_none.wait)
    second = asyncio.create_task(some.run(int, "2"))
    await asyncio.sleep(0)
    has_come.set()
    assert await second == 2
    await until(lambda: all(thread.name != "test-between" for thread in threading.enumerate()))
    async with asyncio.timeout(PATIENCE_S):
        assert await some.run(int, "3") == 3


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
        "from uavlinkd.system.threads import Threads\n"
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
