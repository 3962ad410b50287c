"""What ICE (RFC 8445) connects in the laboratory, by the package aioice: the baseline for direct connections."""

from __future__ import annotations

import asyncio
import importlib.util
import socket
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from time import monotonic
from typing import TYPE_CHECKING, Final

from tests.natlab.laboratory import Place
from tests.natlab.pairs import Pair

if TYPE_CHECKING:
    from aioice import Connection

STUN_PORT: Final = 3478
NEVER_S: Final = 10.0
AT_ONCE: Final = 6
"""Pairs that connect at the same time."""


def why_not() -> str | None:
    """The reason why there is no baseline, or None."""
    return None if importlib.util.find_spec("aioice") else "the package aioice: pip install aioice"


def _answer(server: socket.socket) -> None:
    """Answer a STUN request with the address that it came from."""
    from aioice import stun

    data, address = server.recvfrom(2048)
    request = stun.parse_message(data)
    answer = stun.Message(request.message_method, stun.Class.RESPONSE, request.transaction_id)
    answer.attributes["XOR-MAPPED-ADDRESS"] = address
    server.sendto(bytes(answer), address)


async def connect_all(pairs: Sequence[Pair], public: Place) -> dict[Pair, float | None]:
    """Seconds from the exchange of the candidates to the connection of each pair; None for never."""
    loop = asyncio.get_running_loop()
    # A thread keeps the namespace in which it was started: start the one that aioice uses here.
    loop.set_default_executor(ThreadPoolExecutor(1))
    await loop.run_in_executor(None, int)
    server = public.host.udp_socket(public.address, STUN_PORT)
    loop.add_reader(server, _answer, server)
    gathering, turn = asyncio.Lock(), asyncio.Semaphore(AT_ONCE)

    async def connect(pair: Pair) -> float | None:
        async with turn:
            return await _connect(pair, public.address, gathering)

    try:
        return dict(zip(pairs, await asyncio.gather(*map(connect, pairs)), strict=True))
    finally:
        loop.remove_reader(server)
        server.close()


async def _connect(pair: Pair, server: str, gathering: asyncio.Lock) -> float | None:
    from aioice import Connection

    ends: list[Connection] = []
    try:
        for place in pair.places:
            # Where UDP is blocked, the search for the server would only take its 5 s.
            stun_server = None if place.kind == "no-udp" else (server, STUN_PORT)
            ends.append(Connection(ice_controlling=not ends, stun_server=stun_server, use_ipv6=bool(place.ipv6)))
            async with gathering:
                with place.host.entered():
                    await ends[-1].gather_candidates()
        began = monotonic()
        with suppress(ConnectionError, TimeoutError):
            async with asyncio.timeout(NEVER_S):
                await asyncio.gather(_introduce(*ends), _introduce(*reversed(ends)))
                await ends[0].send(b"through")
                assert await ends[1].recv() == b"through"
                return monotonic() - began
        return None
    finally:
        for end in ends:
            await end.close()


async def _introduce(own: Connection, other: Connection) -> None:
    own.remote_username, own.remote_password = other.local_username, other.local_password
    for candidate in other.local_candidates:
        await own.add_remote_candidate(candidate)
    await own.add_remote_candidate(None)
    await own.connect()
