"""Writes the state of a fleet member to the disk, in a thread: nothing waits for it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Final

from uavlinkd.authority import state_file
from uavlinkd.authority.constants import HAVE_INTERVAL_S
from uavlinkd.authority.state_file import FleetState
from uavlinkd.protocol.constants import NEVER
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import report
from uavlinkd.system.tasks import Threads

STOP_WAIT_S: Final = 2.0
"""A disk that hangs delays the end of the daemon by this time at most."""
_THREAD = Threads(1, "fleet state")


class FleetDisk:
    """The file of one daemon. ``state`` returns what it is to have, ``on_written`` is called with what it has."""

    def __init__(self, path: Path, state: Callable[[], FleetState], on_written: Callable[[FleetState], None]) -> None:
        self._path = path
        self._state = state
        self._on_written = on_written
        self._writing: asyncio.Task[None] | None = None
        self.problem = ""
        """Why the file could not be written; empty if it was."""
        self.again_at = NEVER
        """When it is to be written again: monotonic seconds."""

    def write(self) -> None:
        """Write the present state. A later change during that is written too."""
        self.again_at = NEVER
        if self._writing is None:
            self._writing = asyncio.get_running_loop().create_task(self._write())

    async def stop(self) -> None:
        """Wait for a write that has begun, for at most :data:`STOP_WAIT_S`."""
        if self._writing is not None:
            await asyncio.wait([self._writing], timeout=STOP_WAIT_S)

    async def _write(self) -> None:
        state = None
        try:
            while state != self._state():
                state = self._state()
                await _THREAD.run(state_file.write, self._path, state)
                self.problem = ""
                self._on_written(state)
        except Exception as error:
            if not isinstance(error, OSError):
                report(error)
            reason = (isinstance(error, OSError) and error.strerror) or f"{type(error).__name__}, a fault inside"
            self.problem = f"{self._path} cannot be written: {reason}"
            self.again_at = monotonic() + HAVE_INTERVAL_S
        finally:
            self._writing = None
