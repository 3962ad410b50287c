"""Threads for calls that may hang."""

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


async def test_results_and_exceptions_come_back() -> None:
    """As from a call."""
    some = Threads(2, "test")
    assert await some.run(divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        await some.run(divmod, 7, 0)


async def test_there_are_at_most_so_many_and_they_serve_again() -> None:
    """What comes beyond that waits, and a thread takes one after the other."""
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
    assert sum(each.name == "test-most" for each in threading.enumerate()) == 2
    for _ in tasks:
        gate.release()
    assert sorted(await asyncio.gather(*tasks)) == [(number, "test-most") for number in range(6)]


async def test_idle_threads_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """And others come when there is work again."""
    monkeypatch.setattr(threads, "IDLE_S", 0.01)
    some = Threads(3, "test-idle")
    for _ in range(3):
        await some.run(int)
        await until(lambda: all(each.name != "test-idle" for each in threading.enumerate()))


async def test_work_that_comes_as_a_thread_finds_none_is_done_and_so_is_what_comes_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A thread that has found no work counts as idle before more can come: nobody waits for one that has ended."""
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
    await until(lambda: all(each.name != "test-between" for each in threading.enumerate()))
    async with asyncio.timeout(PATIENCE_S):
        assert await some.run(int, "3") == 3


async def test_a_hanging_call_leaves_its_place_to_nobody_but_its_caller_may_go() -> None:
    """Who is cancelled does not wait; the answer that comes later is nobody's."""
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


def test_the_process_does_not_wait_for_them() -> None:
    """Its end is its end."""
    code = (
        "import asyncio, time\n"
        "from uavlinkd.system.threads import Threads\n"
        "async def work():\n"
        "    asyncio.ensure_future(Threads(1, 'x').run(time.sleep, 600))\n"
        "    await asyncio.sleep(0.05)\n"
        "asyncio.run(work())\n"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


async def test_where_no_thread_can_be_started_the_call_fails_and_a_later_one_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As with a system call: an OSError, and the place is free again."""
    some = Threads(1, "test-none")

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        with pytest.raises(BlockingIOError):  # which is EAGAIN
            await some.run(int)
    assert await some.run(divmod, 7, 2) == (3, 1)
