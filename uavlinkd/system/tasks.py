"""Background tasks whose failure must be reported at once, worker threads for calls that may hang, and signals."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
from collections import deque
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from functools import partial
from threading import Lock, Thread
from typing import Any, Final, TypeVar

from uavlinkd.system.guard import report

T = TypeVar("T")

RESTART_S: Final = 1.0
"""Work of a task that failed begins again after this time."""


def keep_running(work: Callable[[], Coroutine[object, object, None]], name: str) -> asyncio.Task[None]:
    """Start a task in the running loop for work that ends only by cancellation.

    The task reports a failure to the guard at once, and begins the work again: otherwise an endpoint that depends on
    it would stop silently.
    """

    async def repeat() -> None:
        while True:
            try:
                await work()
                return
            except Exception as error:
                report(error)
            await asyncio.sleep(RESTART_S)

    return asyncio.get_running_loop().create_task(repeat(), name=name)


def on_signal(name: str, callback: Callable[[], object]) -> None:
    """Call ``callback`` in the running loop when a signal arrives. Windows lacks some signals."""
    loop = asyncio.get_running_loop()
    number: signal.Signals | None = getattr(signal, name, None)
    if number is None:
        return
    try:
        loop.add_signal_handler(number, callback)
    except NotImplementedError:  # Windows
        signal.signal(number, lambda _, __: loop.call_soon_threadsafe(callback))


class Threads:
    """At most ``limit`` worker threads at a time, called ``name``, for calls that may hang. Further calls wait.

    They are our own because Python joins the threads of executors, which asyncio uses, at exit: a silent name server
    would delay the stop of the daemon.
    """

    def __init__(self, limit: int, name: str) -> None:
        self._name = name
        self._lock = Lock()  # protects the two below, which change together
        self._free = limit  # threads that may still be started
        self._waiting: deque[tuple[Future[Any], partial[Any]]] = deque()

    async def run(self, function: Callable[..., T], *arguments: Any) -> T:
        """Run ``function`` in a worker thread and return its result. Cancelling does not stop the thread.

        Raises OSError if the system cannot start a thread now, else any exception of ``function``.
        """
        future = Future[T]()
        call = future, partial(function, *arguments)
        with self._lock:
            needs_thread = self._free > 0
            if needs_thread:
                self._free -= 1
            else:
                self._waiting.append(call)
        if needs_thread:
            try:
                Thread(target=self._serve, args=call, name=self._name, daemon=True).start()
            except RuntimeError:  # the limit of threads, or no memory
                with self._lock:
                    self._free += 1
                raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from None
        return await asyncio.wrap_future(future)

    def _serve(self, future: Future[Any], call: partial[Any]) -> None:
        """Do the call, and then those that wait."""
        while True:
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(call())
                except Exception as error:  # raised again in `run`
                    future.set_exception(error)
            with self._lock:
                if not self._waiting:
                    self._free += 1
                    return
                future, call = self._waiting.popleft()
