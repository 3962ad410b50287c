"""Two real daemons between the attacker and the autopilot: that of the captured member, and that of its victim."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, Final, Self

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.sitl.roles_links import Link, speaking
from tests.waiting import PATIENCE_S
from uavlinkd.mavlink.policy.roles import ROLES

NO_LIMIT: Final = 1_000_000
"""Frames a second. The rates of roles are tested elsewhere: here as many frames as possible must pass the role."""


class DaemonPair:
    """The attacker's client, the captured member's daemon, the victim's daemon with a role for it, the autopilot.

    TIMESYNC passes too, in both directions: it is the test's barrier.
    """

    def __init__(self, role: str, systems: Sequence[int]) -> None:
        self._policy: Mapping[str, object] = {
            "role": role,
            "system_ids": list(systems),
            "allow_in": ["TIMESYNC"],
            "allow_out": ["TIMESYNC"],
            "rate_in": dict.fromkeys(ROLES[role].rate_in, NO_LIMIT),
        }
        self._sender = (systems[0], 1)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="daemons", daemon=True)
        self._end: asyncio.Event
        self._victim: DaemonProcess
        self._life: Future[None]
        self.peer: Mapping[str, Any] = {}
        """What the victim's `status` says of the captured member at the end."""
        self.endpoint: Mapping[str, Any] = {}
        """The same of the autopilot's endpoint."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(AttributeError):  # no autopilot was attached
            self.stop()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(PATIENCE_S)
        self._loop.close()

    def attach(self, url: str) -> Link:
        """Start both daemons, the victim's with the autopilot at this URL; the attacker's link into the other one."""
        ready: Future[int] = Future()
        self._life = asyncio.run_coroutine_threadsafe(self._live(url, ready), self._loop)
        self._life.add_done_callback(lambda life: _report_failure(life, ready))
        return speaking(ready.result(PATIENCE_S), self._sender)

    def stop(self) -> None:
        """Read the victim's `status`, and end both daemons."""
        self._loop.call_soon_threadsafe(self._end.set)
        self._life.result(PATIENCE_S)

    async def _live(self, url: str, ready: Future[int]) -> None:
        self._end = asyncio.Event()
        async with Stage() as stage:
            victim, captured = stage.daemon("victim"), stage.daemon("captured")
            psk = stage.psk()
            victim.add_peer(captured, [captured.address], psk, **self._policy)
            captured.add_peer(victim, [victim.address], psk, role="all", system_ids="all")
            victim.add_endpoint("autopilot", url)
            _, port = captured.add_endpoint("attacker")
            await stage.start(victim, captured)
            ready.set_result(port)
            await self._end.wait()
            status = await victim.status()
            self.peer, self.endpoint = status["peers"]["captured"], status["endpoints"]["autopilot"]


def _report_failure(life: Future[None], ready: Future[int]) -> None:
    """Pass on why the daemons ended before they were ready."""
    if not ready.done():
        ready.set_exception(life.exception() or RuntimeError("the daemons ended"))
