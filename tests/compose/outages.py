"""What befalls one host of a cluster while the others talk: the same for containers and for namespaces."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Awaitable, Callable

from tests.compose.cluster import SYSTEM_IDS, Cluster, Conversation, until

BACK_S = 2.0
"""From the end of an outage until the link is up, on an idle machine."""
OUTAGE_S = float(os.environ.get("UAVLINKD_OUTAGE_S", "0"))
"""How long a host is cut from the network at least; 60 is the full test. Every outage lasts until all others have
noticed it."""

VICTIM = "drone3"
OTHERS = ("drone1", "drone2", "ground-station")


async def check_frames(cluster: Cluster, count: int = 200) -> None:
    """Each vehicle's frames reach all others once."""
    conversation = Conversation(cluster, tuple(SYSTEM_IDS))
    try:
        await conversation.open()
        await conversation.say_many(count)
        await conversation.check()
    finally:
        conversation.close()


async def check_outage(
    cluster: Cluster, begin: Callable[[], Awaitable[None]], end: Callable[[], Awaitable[None]], lasting_s: float = 0.0
) -> None:
    """An outage of the victim: the others' frames all pass meanwhile, and its links are back in time.

    ``end`` returns once the host can be reached again.
    """
    took_s = 0.0

    async def outage() -> None:
        nonlocal took_s
        await begin()
        began = time.monotonic()
        await until(lambda: cluster.is_missed(VICTIM), f"{VICTIM} is missed")
        await asyncio.sleep(max(0.0, began + lasting_s - time.monotonic()))
        await end()
        took_s = await until(lambda: cluster.is_linked(VICTIM), f"{VICTIM} is back")

    conversation = Conversation(cluster, OTHERS)
    try:
        await conversation.open()
        said = await conversation.during(outage())
        await conversation.check()
    finally:
        conversation.close()
    print(f"back after {took_s:.2f} s; meanwhile each other said {said} frames")
    assert took_s < BACK_S


async def moved(cluster: Cluster) -> None:
    """The host is restarted with another address."""

    async def begin() -> None:
        await cluster.stop(VICTIM)
        await cluster.cut(VICTIM)

    async def end() -> None:
        await cluster.join(VICTIM, elsewhere=True)
        await _start(cluster)

    await check_outage(cluster, begin, end)


async def _start(cluster: Cluster) -> None:
    """Reachable is a daemon that is started once it listens."""
    await cluster.start(VICTIM)
    await until(lambda: cluster.status(VICTIM) is not None, f"{VICTIM} listens")


OUTAGES: dict[str, Callable[[Cluster], Awaitable[None]]] = {
    "stopped": lambda cluster: check_outage(cluster, lambda: cluster.stop(VICTIM), lambda: _start(cluster)),
    "killed": lambda cluster: check_outage(cluster, lambda: cluster.kill(VICTIM), lambda: _start(cluster)),
    "paused": lambda cluster: check_outage(cluster, lambda: cluster.pause(VICTIM), lambda: cluster.resume(VICTIM)),
    "cut_off": lambda cluster: check_outage(
        cluster, lambda: cluster.cut(VICTIM), lambda: cluster.join(VICTIM), cluster.cut_s
    ),
    "moved": moved,
}
