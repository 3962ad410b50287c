"""Background tasks."""

from __future__ import annotations

import asyncio
from typing import Any

from uavlinkd.system.tasks import keep_running


async def test_failure_is_reported_at_once() -> None:
    """The report does not wait for the end of the process."""
    reports: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context))

    async def fail() -> None:
        raise ZeroDivisionError

    task = keep_running(fail(), "the search for drone1")
    await asyncio.wait([task])
    await asyncio.sleep(0)
    assert reports[0]["message"] == "the search for drone1 has failed"
    assert isinstance(reports[0]["exception"], ZeroDivisionError)
    assert reports[0]["task"] is task


async def test_intended_end_is_not_reported() -> None:
    """A task that was cancelled or finished causes no report."""
    reports: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context))
    waiting = keep_running(asyncio.sleep(60), "one that waits")
    done = keep_running(asyncio.sleep(0), "one that ends")
    await asyncio.sleep(0)
    waiting.cancel()
    await asyncio.wait([waiting, done])
    await asyncio.sleep(0)
    assert waiting.cancelled()
    assert reports == []
