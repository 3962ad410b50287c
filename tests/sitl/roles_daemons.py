"""Two real daemons between the attacker and the autopilot: that of the captured member, and that of its victim."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final, Self

from tests.daemon.harness import Stage
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
        self._threads = ThreadPoolExecutor(1, "daemons")
        self._life: Future[None] | None = None
        self._loop: asyncio.AbstractEventLoop
        self._end: asyncio.Event
        self.peer: Mapping[str, Any] = {}
        """What the victim's `status` says of the captured member at the end."""
        self.endpoint: Mapping[str, Any] = {}
        """The same of the autopilot's endpoint."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._threads.shutdown()

    def attach(self, url: str) -> Link:
        """Start both daemons, the victim's with the autopilot at this URL; the attacker's link into the other one."""
        ready: Future[int] = Future()
        self._life = self._threads.submit(lambda: asyncio.run(self._live(url, ready)))
        self._life.add_done_callback(lambda life: _report_failure(life, ready))
        return speaking(ready.result(PATIENCE_S), self._sender)

    def stop(self) -> None:
        """Read the victim's `status`, and end both daemons."""
        if self._life is None:
            return
        if not self._life.done():
            self._loop.call_soon_threadsafe(self._end.set)
        self._life.result(PATIENCE_S)

    async def _live(self, url: str, ready: Future[int]) -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
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
