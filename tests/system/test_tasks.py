"""Tasks that nobody waits for."""

from __future__ import annotations

import asyncio
from typing import Any

from uavlinkd.system.tasks import keep_running


async def test_a_failure_is_told_at_once() -> None:
    """Not at the end of the process, when nobody can do anything about it."""
    told: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context))

    async def fail() -> None:
        raise ZeroDivisionError

    task = keep_running(fail(), "the search for drone1")
    await asyncio.wait([task])
    await asyncio.sleep(0)
    assert told[0]["message"] == "the search for drone1 has failed"
    assert isinstance(told[0]["exception"], ZeroDivisionError)
    assert told[0]["task"] is task


async def test_an_end_on_purpose_is_not_told() -> None:
    """It is cancelled, or has done what it was for."""
    told: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: told.append(context))
    waiting = keep_running(asyncio.sleep(60), "one that waits")
    done = keep_running(asyncio.sleep(0), "one that ends")
    await asyncio.sleep(0)
    waiting.cancel()
    await asyncio.wait([waiting, done])
    await asyncio.sleep(0)
    assert waiting.cancelled()
    assert told == []
