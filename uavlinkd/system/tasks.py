"""Tasks that nobody waits for, and that must not end unseen."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine


def keep_running(work: Coroutine[object, object, None], name: str) -> asyncio.Task[None]:
    """A task of the running loop, for work that ends only where it is cancelled.

    Should it fail, the loop's exception handler is told at once; else nobody would be before the end of the process,
    and what it kept up, such as an endpoint, would just be gone.
    """
    loop = asyncio.get_running_loop()

    def on_done(task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            loop.call_exception_handler({"message": f"{name} has failed", "exception": error, "task": task})

    task = loop.create_task(work, name=name)
    task.add_done_callback(on_done)
    return task
