"""Reloads of the configuration: for SIGHUP, and for requests on the control socket."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress

from uavlinkd.config import ConfigError
from uavlinkd.ops.sdnotify import Supervisor


class Reloads:
    """Reloads run one at a time, in the order of the requests. The configuration of the last one stays in force.

    ``apply`` reads the configuration, and applies or refuses it as a whole. A refusal is a ConfigError.
    """

    def __init__(self, apply: Callable[[], Awaitable[None]], supervisor: Supervisor) -> None:
        self._apply = apply
        self._supervisor = supervisor
        self._loop = asyncio.get_running_loop()
        self._lock = asyncio.Lock()
        self._hangups: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Reload when the reloads before have ended.

        Raises:
            ConfigError: the new configuration was refused.
        """
        async with self._lock:
            self._supervisor.reloading()
            try:
                await self._apply()
            except BaseException:
                self._supervisor.ready("the new configuration was refused")
                raise
            self._supervisor.ready()

    def on_hangup(self) -> None:
        """SIGHUP came: reload, unless a reload waits already, which will read the file later."""
        if len(self._hangups) < 2:
            task = self._loop.create_task(self._reload_for_signal())
            self._hangups.add(task)
            task.add_done_callback(self._hangups.discard)

    async def _reload_for_signal(self) -> None:
        with suppress(ConfigError):  # logged already
            await self.run()
