"""``tcp`` endpoints: they connect, and connect again when a connection ends or a server is missing."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from time import monotonic

import pytest
from structlog.testing import capture_logs

from tests.io.clients import Recorder, address_of, frame, recorder, unused_address, write
from tests.waiting import PATIENCE_S, Stopwatch, until
from uavlinkd.io import resolver, tcp
from uavlinkd.io.tcp import TcpClient, TcpServer, tcp_listener
from uavlinkd.system.addresses import Address

ANY_PORT = Address("127.0.0.1", 0)


@contextmanager
def client_of(address: Address) -> Iterator[TcpClient]:
    """An endpoint that connects to this address."""
    with closing(TcpClient("tcp_client", address, Recorder())) as endpoint:
        endpoint.start()
        yield endpoint


async def test_client_waits_for_a_server_that_is_not_there_yet() -> None:
    """The client connects to a server that starts late, and has no port until then."""
    address = unused_address()
    with client_of(address) as tcp_client:
        with capture_logs() as logs:
            await until(lambda: tcp_client.failures["ECONNREFUSED"] >= 3)
        (line,) = logs  # not one a try
        assert (line["event"], line["log_level"]) == ("endpoint_not_open", "warning")
        assert (line["endpoint"], line["reason"], line["meaning"]) == (
            "tcp_client",
            "ECONNREFUSED",
            "no process listens there now: start it, or correct the port",
        )
        assert list(tcp_client.ports) == []
        with capture_logs() as logs:
            with tcp_listener(address):
                await until(lambda: len(tcp_client.ports) == 1)
            tried = tcp_client.failures["ECONNREFUSED"]
            await until(lambda: tcp_client.failures["ECONNREFUSED"] > tried)
        assert logs == []  # it was open for a moment only


async def test_client_follows_a_server_that_restarts(server: TcpServer) -> None:
    """The port is reported as closed, and a new one as opened, within a second if the server had sent frames."""
    server.start()
    address = Address(*address_of(server))
    with client_of(address) as tcp_client:
        await until(lambda: len(server.ports) == 1)
        write(server.ports[0], [frame(1)], monotonic())
        await until(lambda: recorder(tcp_client).received == [frame(1)])
        (before,) = tcp_client.ports
        server.close()
        await until(lambda: recorder(tcp_client).closed == [before])
        with closing(TcpServer("again", tcp_listener(address), Recorder())) as again:
            again.start()
            watch = Stopwatch()
            await until(lambda: len(again.ports) == 1)
            assert watch.calm_s < 1.0
            write(again.ports[0], [frame(2)], monotonic())
            await until(lambda: recorder(tcp_client).received == [frame(1), frame(2)])
            assert tcp_client.ports[0] is not before


async def test_waits_grow_where_a_server_only_accepts_and_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each wait is twice the previous one, up to the longest, although every attempt connects."""
    waits: list[float] = []
    sleep = asyncio.sleep

    async def short(delay: float) -> None:
        waits.append(delay)
        await sleep(0)

    def accept_and_close() -> None:
        listener.accept()[0].close()

    listener = tcp_listener(ANY_PORT)
    asyncio.get_running_loop().add_reader(listener, accept_and_close)
    tcp_client = TcpClient("tcp_client", Address(*listener.getsockname()), Recorder())
    with monkeypatch.context() as patched:
        patched.setattr(asyncio, "sleep", short)
        tcp_client.start()
        while len(waits) < 8:
            await sleep(0)
        tcp_client.close()
    asyncio.get_running_loop().remove_reader(listener)
    listener.close()
    for wait_s, least_s in zip(waits, [0.25, 0.5, 1.0, 2.0, 4.0, 5.0, 5.0, 5.0], strict=False):
        assert least_s <= wait_s <= 1.25 * least_s


async def test_silent_name_server_of_the_peers_delays_no_endpoint(
    server: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their look-ups may use all threads of theirs."""
    server.start()
    is_over, waiting = threading.Event(), list[bytes]()

    def look_up(host: bytes, port: int, **_: object) -> list[tuple[object, ...]]:
        if host == b"peer.test":
            waiting.append(host)
            is_over.wait(PATIENCE_S)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", address_of(server))]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    peers = [asyncio.create_task(resolver.resolve(Address("peer.test", 1))) for _ in range(resolver.MAX_THREADS)]
    await until(lambda: len(waiting) == resolver.MAX_THREADS)
    with client_of(Address("autopilot.test", 5760)) as tcp_client:
        await until(lambda: len(tcp_client.ports) == 1)
    is_over.set()
    await asyncio.gather(*peers)


async def test_connection_to_oneself_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """If no process listens, the kernel may pick the same port for our side, and TCP connects to itself."""
    address = unused_address()
    prepare = tcp._prepare

    def prepare_there(sock: socket.socket) -> None:
        prepare(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((address.host, address.port))

    monkeypatch.setattr(tcp, "_prepare", prepare_there)
    with client_of(address) as tcp_client:
        await until(lambda: tcp_client.failures["ECONNREFUSED"] > 0)
        assert recorder(tcp_client).open == []
