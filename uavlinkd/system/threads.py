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
from threading import Lock, Thread
from typing import Any, TypeVar

IDLE_S = 10.0
"""A thread without work ends after so long."""

T = TypeVar("T")


class Threads:
    """At most so many at a time; what comes beyond that waits for its turn."""

    def __init__(self, most: int, name: str) -> None:
        self._name = name
        self._work: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._lock = Lock()
        """Held while the queue and the two counts below change together."""
        self._idle = 0  # threads that wait, and that no work counts on yet
        self._slots = most  # threads that may still be started

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

        if self._put(work):
            try:
                Thread(target=self._serve, name=self._name, daemon=True).start()
            except RuntimeError:  # too many, or no memory
                with self._lock:
                    self._slots += 1
                future.cancel()  # should another thread find the work after all
                raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from None
        return await future

    def _put(self, work: Callable[[], None]) -> bool:
        """Leave it to the threads; whether one is to be started for it."""
        with self._lock:
            self._work.put(work)
            if self._idle:
                self._idle -= 1
                return False
            if not self._slots:
                return False
            self._slots -= 1
            return True

    def _serve(self) -> None:
        while True:
            work = self._take()
            if work is None:
                try:
                    work = self._work.get(timeout=IDLE_S)
                except Empty:
                    if self._may_end():
                        return
                    continue
            work()

    def _take(self) -> Callable[[], None] | None:
        """Work; None where there is none, and the thread counts as idle."""
        with self._lock:
            try:
                return self._work.get_nowait()
            except Empty:
                self._idle += 1
                return None

    def _may_end(self) -> bool:
        """Whether no work counts on an idle thread; then it is no longer there."""
        with self._lock:
            if not self._idle:
                return False
            self._idle -= 1
            self._slots += 1
            return True


def _settle(future: asyncio.Future[Any], settle: Callable[[Any], None], outcome: object) -> None:
    if not future.done():
        settle(outcome)
