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
"""Longest wait between look-ups while the addresses do not answer."""
RELAXED_WAIT_S = 30.0
"""Longest wait between look-ups while a name fails whose addresses are not urgent: other addresses answer. A query
per second would cost 17 MB a day on a metered network."""
MAX_QUERIES = 3
"""Concurrent look-ups of one name whose addresses are urgent. The system repeats a query to a silent server after
5 s and gives up after 10 s (resolv.conf(5)): look-ups that begin :data:`OVERLAP_S` apart send a query as often."""
OVERLAP_S = 1.7
MAX_THREADS = 32
"""At most what systemd's unit allows: names without an answer do not delay others while there are ten of them."""

_THREADS = Threads(MAX_THREADS, "look-up")


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
    # As bytes: Python would encode a text by IDNA, whose tables take 0.2 MB.
    answers = socket.getaddrinfo(address.host.encode("ascii"), address.port, type=socket.SOCK_DGRAM, flags=flags)
    return list(dict.fromkeys((family, sockaddr) for family, _, _, _, sockaddr in answers))


async def keep_resolving(
    address: Address,
    interval_s: Callable[[], float],
    on_resolved: Callable[[Resolved], bool],
    log: FilteringBoundLogger,
    unresolved: set[str] | None = None,
    wake: asyncio.Event | None = None,
) -> None:
    """Resolve an address now and repeatedly. Runs until cancelled, or until a numeric address was used.

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
    queries: set[Query] = set()
    loop = asyncio.get_running_loop()
    last_at, wait_s = -inf, 0.0  # of the newest query or the last answer; the pause after a failure, which grows
    try:
        while True:
            asked_s, now = interval_s(), loop.time()
            is_urgent = asked_s <= LONGEST_WAIT_S
            if queries:
                pause_s = OVERLAP_S
            elif is_urgent:
                pause_s = min(wait_s, LONGEST_WAIT_S)
            elif known and address.host not in unresolved:
                pause_s, wait_s = asked_s, 0.0
            else:
                pause_s = min(asked_s, wait_s)
            may_query = not queries or (is_urgent and len(queries) < MAX_QUERIES)
            if may_query and (wake.is_set() or now >= last_at + pause_s):
                wake.clear()
                last_at = now
                queries.add(asyncio.ensure_future(resolve(address)))
                continue
            left_s = min(last_at + pause_s - now, FIRST_WAIT_S) if may_query else FIRST_WAIT_S
            if not queries:
                with suppress(TimeoutError):
                    async with asyncio.timeout(left_s):
                        await wake.wait()
                continue
            answered, queries = await asyncio.wait(queries, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
            if not answered:
                continue
            # A server that is back may answer several at once: use the result with the most addresses.
            resolved = max((query.result() for query in answered), key=len)
            if resolved:
                unresolved.discard(address.host)
                _cancel(queries)
                if resolved != known and on_resolved(resolved):
                    known = resolved
                    if address.ip is not None and "%" not in address.host:
                        return  # a number stays what it is; an interface may get another one
            elif address.host not in unresolved:
                unresolved.add(address.host)
                log.warning("name_not_resolved", host=address.host, meaning=meaning_of(NAME_NOT_RESOLVED))
            wait_s = max(FIRST_WAIT_S, min(2 * wait_s, RELAXED_WAIT_S))
            if not queries:
                last_at = loop.time()
    finally:
        _cancel(queries)


def _cancel(queries: set[Query]) -> None:
    for query in queries:
        query.cancel()
    queries.clear()
