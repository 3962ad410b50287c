"""Host names to addresses, again and again: networks come and go, and so do the addresses behind names."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Sequence
from typing import Any

from structlog.typing import FilteringBoundLogger

from uavlinkd.system.addresses import Address
from uavlinkd.endpoints.sockets import numeric_host
from uavlinkd.system.threads import Threads

Resolved = list[tuple[socket.AddressFamily, str, int]]

FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 1.0
"""Between look-ups while an answer is wanted: a link is up within 2 s of the name server's return, with up to six
peers that are given by name."""
QUESTIONS_AT_ONCE = 5
"""About the names of one peer. A question to a name server that is silent takes the system 5 s to repeat and 10 s to
give up (resolv.conf(5)); with five of them, begun a second apart, one is put or repeated each second."""
MOST_THREADS = 32
"""No more than systemd's unit allows. Where more peers than six are looked up at once, each has its share of them, so
that names which nobody answers for do not hold up the others."""

_THREADS = Threads(MOST_THREADS, "look-up")
_asking_now: set[object] = set()


def _share() -> int:
    return max(1, min(QUESTIONS_AT_ONCE, MOST_THREADS // max(1, len(_asking_now))))


async def resolve(addresses: Sequence[Address]) -> tuple[Resolved, list[str]]:
    """Every numeric address behind ``addresses``, in their order; and the names that have none now."""
    resolved: Resolved = []
    failed: list[str] = []
    for address in addresses:
        try:
            if address.ip is None:
                found = await _THREADS.run(_look_up, address, 0)
            else:
                found = _look_up(address, socket.AI_NUMERICHOST)  # which asks nobody
        except (OSError, UnicodeError):
            failed.append(address.host)
            continue
        for family, _, _, _, sockaddr in found:
            each = (family, numeric_host(sockaddr), int(sockaddr[1]))
            if each not in resolved:
                resolved.append(each)
    return resolved, failed


def _look_up(address: Address, flags: int) -> list[tuple[Any, ...]]:
    return socket.getaddrinfo(*address.sockaddr, type=socket.SOCK_DGRAM, flags=flags)


async def keep_resolving(
    addresses: Sequence[Address],
    is_wanted: Callable[[], bool],
    on_resolved: Callable[[Resolved], bool],
    log: FilteringBoundLogger,
) -> None:
    """Look the names up now, and again while ``is_wanted`` says that what they gave does not answer.

    Runs until cancelled. ``on_resolved`` is called with what is new, and again later where it gives False: it could
    do nothing with that now. Names that fail are logged once each time that they begin to fail.
    """
    known: Resolved = []
    failing: set[str] = set()
    wait_s = FIRST_WAIT_S
    asking: set[asyncio.Task[tuple[Resolved, list[str]]]] = set()
    loop = asyncio.get_running_loop()
    asked_at = loop.time()
    me = object()
    takes_threads = any(each.ip is None for each in addresses)
    try:
        while True:
            if not known or failing or is_wanted():
                if takes_threads:
                    _asking_now.add(me)
                if len(asking) < _share():
                    asked_at = loop.time()
                    asking.add(asyncio.ensure_future(resolve(addresses)))
                answered, asking = await asyncio.wait(
                    asking, timeout=LONGEST_WAIT_S, return_when=asyncio.FIRST_COMPLETED
                )
                if not answered:
                    continue
                # Where it was an older question's end, the newest still counts its second.
                rest_s = asked_at + LONGEST_WAIT_S - loop.time() if asking else wait_s
                # Several may come at once, from a server that is back: what counts is who found most.
                found, failed = max((each.result() for each in answered), key=lambda told: len(told[0]))
                for name in set(failed) - failing:
                    log.warning("name_not_resolved", host=name)
                failing = set(failed)
                if found and found != known and on_resolved(found):
                    known = found
                if not failed:
                    _forget(asking)
                wait_s = min(2 * wait_s, LONGEST_WAIT_S)
            else:
                _asking_now.discard(me)
                wait_s = rest_s = FIRST_WAIT_S
            await asyncio.sleep(rest_s)
    finally:
        _asking_now.discard(me)
        _forget(asking)


def _forget(asking: set[asyncio.Task[tuple[Resolved, list[str]]]]) -> None:
    """What these answer would be old when it is looked at."""
    for task in asking:
        task.cancel()
    asking.clear()
