"""Findings in the status of real daemons."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager, suppress
from typing import Any

from tests.daemon.process import DaemonProcess, Status
from tests.daemon.udp import Client, Sockaddr
from uavlinkd.ops.causes import Cause


def findings(status: Status, subject: str, name: str) -> dict[str, dict[str, Any]]:
    """The findings about a peer, an endpoint or (without a name) the daemon, by cause."""
    return {
        finding["cause"]: finding
        for finding in status["findings"]
        if (finding["subject"], finding["name"]) == (subject, name)
    }


async def until_found(daemon: DaemonProcess, cause: Cause, name: str = "", subject: str = "") -> dict[str, Any]:
    """Wait for a finding about a peer, or the daemon without a name, and return it."""
    subject = subject or ("peer" if name else "daemon")
    status = await daemon.until(lambda status: cause in findings(status, subject, name))
    return findings(status, subject, name)[cause]


async def until_gone(daemon: DaemonProcess, cause: Cause) -> None:
    """Wait until there is no such finding."""
    await daemon.until(lambda status: all(finding["cause"] != cause for finding in status["findings"]))


@asynccontextmanager
async def sending(client: Client, into: Sockaddr, frames: Callable[[int], Iterable[bytes]]) -> AsyncIterator[None]:
    """Send ``frames(0)``, ``frames(1)`` and so on, some each second, until the end of the block."""

    async def send() -> None:
        number = 0
        while True:
            for frame in frames(number):
                client.send(frame, into)
            number += 1
            await asyncio.sleep(0.2)

    task = asyncio.create_task(send())
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
