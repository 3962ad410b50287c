"""``uavlinkd demo --web``: the page of one of the two daemons, on loopback."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from uavlinkd.lab.evaluation.middle import HOST
from uavlinkd.system.addresses import Address
from uavlinkd.web.page import Page


@asynccontextmanager
async def serving(control_socket: Path) -> AsyncIterator[None]:
    """Serve the page of this daemon, and print where."""
    with Page(control_socket, Address(HOST, 0)) as page:
        print(f"the page is at {page.url} until Ctrl-C", flush=True)
        task = asyncio.create_task(page.run())
        try:
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
