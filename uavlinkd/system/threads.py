"""Worker threads for calls that may hang, such as name look-ups.

They are our own because Python joins the threads of ``concurrent.futures``, which asyncio uses, at exit: a silent
name server would delay the stop of the daemon.
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
"""A thread without work ends after this time."""

T = TypeVar("T")


class Threads:
    """At most ``limit`` worker threads, called ``name``. Further calls wait in a queue."""

    def __init__(self, limit: int, name: str) -> None:
        self._name = name
        self._work: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._lock = Lock()
        """Protects the queue and the two counts below, which change together."""
        self._idle = 0  # waiting threads that no queued call has claimed
        self._slots = limit  # threads that may still be started

    async def run(self, function: Callable[..., T], *arguments: Any) -> T:
        """Run ``function`` in a worker thread and return its result. Cancelling does not stop the thread.

        Raises:
            OSError: the system cannot start a thread now.
            Exception: any exception of ``function``.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[T] = loop.create_future()

        def work() -> None:
            if future.cancelled():
                return
            try:
                settle: tuple[Callable[[Any], None], object] = future.set_result, function(*arguments)
            except Exception as error:  # raised again in `run`
                settle = future.set_exception, error
            with suppress(RuntimeError):  # the loop is closed: no coroutine waits
                loop.call_soon_threadsafe(_settle, future, *settle)

        if self._put(work):
            try:
                Thread(target=self._serve, name=self._name, daemon=True).start()
            except RuntimeError:  # the limit of threads, or no memory
                with self._lock:
                    self._slots += 1
                future.cancel()  # another thread may still take the work from the queue
                raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from None
        return await future

    def _put(self, work: Callable[[], None]) -> bool:
        """Queue work. Returns whether a new thread is needed for it."""
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
            work = self._next()
            if work is None:
                try:
                    work = self._work.get(timeout=IDLE_S)
                except Empty:
                    if self._may_end():
                        return
                    continue
            work()

    def _next(self) -> Callable[[], None] | None:
        """The next work; None if the queue is empty, and then the thread counts as idle."""
        with self._lock:
            try:
                return self._work.get_nowait()
            except Empty:
                self._idle += 1
                return None

    def _may_end(self) -> bool:
        """Whether the idle thread may end, because no queued call has claimed it. Then its slot is free again."""
        with self._lock:
            if not self._idle:
                return False
            self._idle -= 1
            self._slots += 1
            return True


def _settle(future: asyncio.Future[Any], settle: Callable[[Any], None], result: object) -> None:
    if not future.done():
        settle(result)
