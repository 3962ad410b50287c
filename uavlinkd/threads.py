"""Threads for calls that may hang, such as look-ups of names: the end of the process does not wait for them.

The executors of asyncio and ``concurrent.futures`` are joined at the end: a silent name server would then hold up a
daemon that was told to stop.
"""

from __future__ import annotations

import asyncio
import errno
import os
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Semaphore, Thread
from typing import Any, TypeVar

IDLE_S = 10.0
"""A thread without work ends after so long."""

T = TypeVar("T")


class Threads:
    """At most so many at a time; what comes beyond that waits for its turn."""

    def __init__(self, most: int, name: str) -> None:
        self._most = most
        self._name = name
        self._work: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._idle = Semaphore(0)
        self._slots = Semaphore(most)

    async def run(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call it in a thread, and give what it gives. Who is cancelled meanwhile leaves it to itself.

        Raises:
            OSError: no thread can be started now.
            Exception: whatever it raises.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[T] = loop.create_future()

        def work() -> None:
            if future.cancelled():
                return
            try:
                settle: tuple[Callable[[Any], None], object] = future.set_result, function(*arguments)
            except Exception as error:  # who waits is told
                settle = future.set_exception, error
            with suppress(RuntimeError):  # the loop is closed: nobody waits any more
                loop.call_soon_threadsafe(_settle, future, *settle)

        self._work.put(work)
        if not self._idle.acquire(blocking=False) and self._slots.acquire(blocking=False):
            try:
                Thread(target=self._serve, name=self._name, daemon=True).start()
            except RuntimeError:  # too many, or no memory
                self._slots.release()
                future.cancel()  # should another thread find the work after all
                raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from None
        return await future

    def _serve(self) -> None:
        while True:
            try:
                work = self._work.get_nowait()
            except Empty:
                self._idle.release()
                try:
                    work = self._work.get(timeout=IDLE_S)
                except Empty:
                    if self._idle.acquire(blocking=False):  # else somebody counts on this thread
                        self._slots.release()
                        return
                    continue
            work()


def _settle(future: asyncio.Future[Any], settle: Callable[[Any], None], outcome: object) -> None:
    if not future.done():
        settle(outcome)
