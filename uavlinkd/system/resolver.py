"""Resolves host names to addresses, repeatedly, because networks and their addresses change during a flight.

It uses the system's resolver and not a DNS library, so that names mean the same here as for every other tool:
hosts file, mDNS and search domains included.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress
from math import inf
from typing import Any

from structlog.typing import FilteringBoundLogger

from uavlinkd.system.addresses import Address
from uavlinkd.system.error_meanings import NAME_NOT_RESOLVED, meaning_of
from uavlinkd.system.tasks import Threads

Resolved = list[tuple[socket.AddressFamily, Any]]
"""Family and socket address of each address, as the kernel takes them."""
Query = asyncio.Task[Resolved]

FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 1.0
"""Longest wait between look-ups while the addresses do not answer. With up to six named peers, a link is up within
2 s of the name server's return."""
RELAXED_WAIT_S = 30.0
"""Longest wait between look-ups while a name fails whose addresses are not urgent: other addresses answer. A query
per second would cost 17 MB a day on a metered network."""
MAX_QUERIES = 5
"""Concurrent look-ups of one peer's names. The system repeats a query to a silent name server after 5 s and gives up
after 10 s (resolv.conf(5)). Five look-ups, started 1 s apart, send one query per second."""
MAX_THREADS = 32
"""At most what systemd's unit allows. More than six peers share them equally, so that names without an answer do not
delay others."""

_THREADS = Threads(MAX_THREADS, "look-up")
_active: set[object] = set()


def _share() -> int:
    return max(1, min(MAX_QUERIES, MAX_THREADS // max(1, len(_active))))


async def resolve(address: Address, threads: Threads | None = None) -> Resolved:
    """Every numeric address of ``address``, each once; empty if it does not resolve now."""
    if address.ip is not None:
        return numeric(address)
    try:
        return await (threads or _THREADS).run(_look_up, address, 0)
    except (OSError, UnicodeError):
        return []


def numeric(address: Address) -> Resolved:
    """The socket address of a numeric address, without a query; empty if this machine lacks its family."""
    try:
        return _look_up(address, socket.AI_NUMERICHOST)
    except (OSError, UnicodeError):
        return []


def _look_up(address: Address, flags: int) -> Resolved:
    answers = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM, flags=flags)
    return list(dict.fromkeys((family, sockaddr) for family, _, _, _, sockaddr in answers))


async def keep_resolving(
    address: Address,
    interval_s: Callable[[], float],
    on_resolved: Callable[[Resolved], bool],
    log: FilteringBoundLogger,
    unresolved: set[str] | None = None,
    wake: asyncio.Event | None = None,
) -> None:
    """Resolve an address now and repeatedly. Runs until cancelled.

    ``interval_s`` returns the interval between look-ups as of now: :data:`LONGEST_WAIT_S` if the addresses so far do
    not answer. Then the first intervals are shorter. While the name fails, the interval is at most
    :data:`RELAXED_WAIT_S`. Set ``wake`` to have the name resolved at once.

    ``on_resolved`` is called with each new result. If it returns False, it could not use the result, and is called
    with it again later. The name is logged once each time that it begins to fail. It is in ``unresolved`` while the
    last attempt failed.
    """
    known: Resolved = []
    unresolved = set() if unresolved is None else unresolved
    wake = asyncio.Event() if wake is None else wake
    wait_s = 0.0
    queries: set[Query] = set()
    loop = asyncio.get_running_loop()
    queried_at = answered_at = -inf
    me = object()
    try:
        while True:
            asked_s, now = interval_s(), loop.time()
            is_urgent, is_failing = asked_s <= LONGEST_WAIT_S, address.host in unresolved or not known
            if address.ip is None and (is_urgent or is_failing):
                _active.add(me)
            else:
                _active.discard(me)
            if not is_urgent and not is_failing:
                wait_s = 0.0
            # While other queries are open, the next one starts a second after the newest of them.
            due_at = queried_at + LONGEST_WAIT_S
            if not queries:
                due_at = answered_at + _interval_s(asked_s, wait_s, is_failing=is_failing)
            may_query = not queries or (is_urgent and len(queries) < _share())
            if may_query and (now >= due_at or wake.is_set()):
                wake.clear()
                queried_at = now
                queries.add(asyncio.ensure_future(resolve(address)))
                continue
            if not queries:
                with suppress(TimeoutError):
                    async with asyncio.timeout(min(due_at - now, FIRST_WAIT_S)):
                        await wake.wait()
                continue
            answered, queries = await asyncio.wait(
                queries, timeout=due_at - now if may_query else LONGEST_WAIT_S, return_when=asyncio.FIRST_COMPLETED
            )
            if not answered:
                continue
            # A server that is back may answer several at once: use the result with the most addresses.
            resolved = max((query.result() for query in answered), key=len)
            if resolved:
                unresolved.discard(address.host)
                _cancel(queries)
                if resolved != known and on_resolved(resolved):
                    known = resolved
            elif address.host not in unresolved:
                unresolved.add(address.host)
                log.warning("name_not_resolved", host=address.host, meaning=meaning_of(NAME_NOT_RESOLVED))
            answered_at, wait_s = loop.time(), max(FIRST_WAIT_S, min(2 * wait_s, RELAXED_WAIT_S))
    finally:
        _active.discard(me)
        _cancel(queries)


def _interval_s(asked_s: float, wait_s: float, *, is_failing: bool) -> float:
    """The interval until the next look-up. ``wait_s`` grows with each."""
    if asked_s <= LONGEST_WAIT_S:
        return min(wait_s, LONGEST_WAIT_S)
    return min(asked_s, wait_s) if is_failing else asked_s


def _cancel(queries: set[Query]) -> None:
    for query in queries:
        query.cancel()
    queries.clear()
