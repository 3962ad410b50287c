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
