"""Background tasks whose failure must be reported at once."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine


def keep_running(work: Coroutine[object, object, None], name: str) -> asyncio.Task[None]:
    """Start a task in the running loop for work that ends only by cancellation.

    The task reports a failure to the loop's exception handler at once. Otherwise asyncio would report it at the end
    of the process, and an endpoint that depends on the task would stop silently.
    """
    loop = asyncio.get_running_loop()

    def on_done(task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            loop.call_exception_handler({"message": f"{name} has failed", "exception": error, "task": task})

    task = loop.create_task(work, name=name)
    task.add_done_callback(on_done)
    return task
