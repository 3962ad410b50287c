"""Worker threads for calls that may hang, such as name look-ups.

They are our own because Python joins the threads of ``concurrent.futures``, which asyncio uses, at exit: a silent
name server would delay the stop of the daemon.
"""

from __future__ import annotations

import asyncio
import errno
import os
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from threading import Lock, Thread
from typing import Any, TypeVar

T = TypeVar("T")


class Threads:
    """At most ``limit`` worker threads at a time, called ``name``. Further calls wait in a queue."""

    def __init__(self, limit: int, name: str) -> None:
        self._name = name
        self._lock = Lock()
        """Protects the two below, which change together."""
        self._free = limit  # threads that may still be started
        self._waiting: deque[Callable[[], None]] = deque()

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

        with self._lock:
            needs_thread = self._free > 0
            if needs_thread:
                self._free -= 1
            else:
                self._waiting.append(work)
        if needs_thread:
            try:
                Thread(target=self._serve, args=(work,), name=self._name, daemon=True).start()
            except RuntimeError:  # the limit of threads, or no memory
                with self._lock:
                    self._free += 1
                raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from None
        return await future

    def _serve(self, work: Callable[[], None]) -> None:
        """Do the work, and then what waits."""
        while True:
            work()
            with self._lock:
                if not self._waiting:
                    self._free += 1
                    return
                work = self._waiting.popleft()


def _settle(future: asyncio.Future[Any], settle: Callable[[Any], None], result: object) -> None:
    if not future.done():
        settle(result)
