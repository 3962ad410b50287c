"""``tcpin`` endpoints: many clients at once, and none delays another."""

from __future__ import annotations

import asyncio
import resource
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from fcntl import ioctl
from time import monotonic

import pytest

from tests.io.clients import address_of, frame, large_frame, recorder, write
from tests.waiting import until
from uavlinkd.io import tcp
from uavlinkd.io.ports import CLIENT_SILENT_S, CLIENTS_PER_ENDPOINT
from uavlinkd.io.tcp import TcpServer
from uavlinkd.system.addresses import Address

SIOCOUTQNSD = 0x894B
"""Bytes that TCP has not sent: linux/sockios.h."""
ANY_PORT = Address("127.0.0.1", 0)

Connect = Callable[[], socket.socket]


@pytest.fixture
def connect(server: TcpServer) -> Iterator[Connect]:
    """Connects a client to the server."""
    with ExitStack() as stack:
        yield lambda: stack.enter_context(socket.create_connection(address_of(server), timeout=60))


async def test_each_client_is_a_port(server: TcpServer, connect: Connect) -> None:
    """Frames are reported with their client, and sent to one client only."""
    first, second = connect(), connect()
    server.on_acceptable(now=0.0)
    ports = {port.name: port for port in server.ports}
    assert set(ports) == {str(Address(*client.getsockname())) for client in (first, second)}
    second.sendall(frame(2))
    server.start()
    await until(lambda: recorder(server).received == [frame(2)])
    for number, client in enumerate((first, second)):
        port = ports[str(Address(*client.getsockname()))]
        assert (port.received_at is not None) == (client is second)
        write(port, [frame(10 + number)], monotonic())
        assert client.recv(100) == frame(10 + number)
    first.close()
    await until(lambda: len(server.ports) == 1)
    assert [port.name for port in server.ports] == [str(Address(*second.getsockname()))]


async def test_new_client_is_refused_while_all_places_are_in_use(server: TcpServer, connect: Connect) -> None:
    """The limit holds, and the present clients stay."""
    for _ in range(CLIENTS_PER_ENDPOINT):
        connect()
        server.on_acceptable(now=100.0)
    there = list(server.ports)
    newcomer = connect()
    server.on_acceptable(now=100.0 + CLIENT_SILENT_S - 0.01)
    assert newcomer.recv(1) == b""
    assert list(server.ports) == there
    assert len(there) == CLIENTS_PER_ENDPOINT
    assert server.failures == {"too_many_clients": 1}


async def test_new_client_displaces_the_one_that_is_silent_longest(server: TcpServer, connect: Connect) -> None:
    """Connections that are never used cannot lock others out."""
    clients = [connect() for _ in range(CLIENTS_PER_ENDPOINT)]
    for at in range(2):  # the kernel queues as many connections as there are places
        server.on_acceptable(now=100.0 + at)
    there = list(server.ports)
    speaks = next(client for client in clients if str(Address(*client.getsockname())) == there[0].name)
    speaks.sendall(frame(1))
    there[0].on_readable(now=104.0)
    newcomer = connect()
    server.on_acceptable(now=100.0 + CLIENT_SILENT_S)
    assert recorder(server).closed == [there[1]]
    assert [port.name for port in server.ports] == [
        *(port.name for port in there if port is not there[1]),
        str(Address(*newcomer.getsockname())),
    ]
    assert server.failures == {"displaced": 1}


@pytest.mark.parametrize(
    "request_line",
    [b"POST / HTTP/1.1\r\n", b"GET /?x HTTP/1.1\r\n", b"OPTIONS * HTTP/1.1\r\n", b"\x16\x03\x01\x02\x00\x01"],
)
async def test_browser_is_refused(server: TcpServer, connect: Connect, request_line: bytes) -> None:
    """A web page can make a browser post frames to a local port: they are dropped, anywhere in the request."""
    server.start()
    client = connect()
    client.sendall(request_line + b"Host: localhost\r\n\r\n" + 20 * frame(1))
    await until(lambda: server.failures["http"] == 1)
    await until(lambda: bool(recorder(server).closed))
    assert recorder(server).received == []


async def test_text_of_an_autopilot_is_not_a_browser(server: TcpServer, connect: Connect) -> None:
    """Boot messages, and HTTP words later in the stream, are accepted."""
    server.start()
    client = connect()
    client.sendall(b"Init ArduCopter\r\n" + frame(1))
    await until(lambda: recorder(server).received == [frame(1)])
    client.sendall(b"GET " + frame(2))
    await until(lambda: recorder(server).received == [frame(1), frame(2)])
    assert server.failures.total() == 0


async def test_without_file_descriptors_the_server_waits(
    server: TcpServer, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A connection that cannot be accepted now is accepted later, and the event loop does not spin until then."""
    monkeypatch.setattr(tcp, "ACCEPT_PAUSE_S", 0.05)
    connect()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket() as lowest_free:
        bound = lowest_free.fileno()
    resource.setrlimit(resource.RLIMIT_NOFILE, (bound, hard))
    try:
        server.start()
        await until(lambda: server.failures["EMFILE"] > 0)
        for _ in range(100):
            await asyncio.sleep(0)
        assert server.failures["EMFILE"] == 1
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    await until(lambda: len(server.ports) == 1)


async def test_kernel_holds_little_for_a_client_that_never_reads(server: TcpServer, connect: Connect) -> None:
    """Frames that cannot be sent wait in the endpoint, where they can be dropped. The kernel gets a few dozen."""
    server.on_acceptable(0.0)
    client = connect()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    server.on_acceptable(0.0)
    (port,) = server.ports
    for number in range(2000):
        write(port, [large_frame(number)], monotonic())
        await asyncio.sleep(0)
    on_our_side = server.bytes_sent - len(client.recv(1 << 20, socket.MSG_PEEK))
    assert on_our_side < 65536
    not_sent = int.from_bytes(ioctl(port.channel.fileno(), SIOCOUTQNSD, bytes(4)), sys.byteorder)
    assert not_sent < 1024 + 1400
    waiting = len(port.outgoing)
    assert server.frames_sent + server.failures["outgoing_full"] + server.failures["stale"] + waiting == 2000
