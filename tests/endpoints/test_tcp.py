"""TCP ports: connected again and again, many at once, and none of them in the way of another."""

from __future__ import annotations

import asyncio
import os
import resource
import socket
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from fcntl import ioctl
from time import monotonic

import pytest
from structlog.testing import capture_logs

from tests.endpoints.clients import Recorder, eventually, frame, large_frame, measure_udp_delivery, write
from uavlinkd.system.addresses import Address
from uavlinkd.endpoints import tcp
from uavlinkd.endpoints.sockets import BindError
from uavlinkd.endpoints.stream_endpoint import MAX_AGE_S, STALLED_S
from uavlinkd.endpoints.tcp import CLIENT_QUIET_S, CLIENTS_PER_ENDPOINT, MAX_GAP_S, TcpClient, TcpServer, tcp_listener

SIOCOUTQNSD = 0x894B
"""Bytes that TCP has not sent: linux/sockios.h."""
ANY_PORT = Address("127.0.0.1", 0)

Connect = Callable[[], socket.socket]


def recorder(endpoint: TcpServer | TcpClient) -> Recorder:
    assert isinstance(endpoint.handler, Recorder)
    return endpoint.handler


@pytest.fixture
async def server() -> AsyncIterator[TcpServer]:
    """Listening, not yet started: a test may call ``on_acceptable`` at times of its own."""
    endpoint = TcpServer("server", tcp_listener(ANY_PORT), Recorder())
    yield endpoint
    endpoint.close()


@pytest.fixture
def connect(server: TcpServer) -> Iterator[Connect]:
    """Connects a program to the server."""
    programs: list[socket.socket] = []

    def _connect() -> socket.socket:
        program = socket.create_connection(server.address, timeout=5)
        programs.append(program)
        return program

    yield _connect
    for program in programs:
        program.close()


def unused_address() -> Address:
    with socket.socket() as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(("127.0.0.1", 0))
        return Address(*sock.getsockname())


# Listening.


def test_taken_address_is_named() -> None:
    """Two programs on one port is for the operator to sort out."""
    with tcp_listener(ANY_PORT) as first:
        taken = Address(*first.getsockname())
        with pytest.raises(BindError, match=f"cannot listen on {taken}: Address already in use"):
            tcp_listener(taken)


def test_name_is_not_looked_up_to_listen() -> None:
    """A listening address is numeric: where a name points is another's decision."""
    with pytest.raises(BindError, match="cannot use localhost:5760"):
        tcp_listener(Address("localhost", 5760))


async def test_address_is_free_again_after_a_restart(server: TcpServer, connect: Connect) -> None:
    """Connections that were closed from here do not keep the next daemon from listening."""
    address = Address(*server.address)
    program = connect()
    server.on_acceptable(now=0.0)
    server.close()
    assert program.recv(1) == b""
    program.close()
    tcp_listener(address).close()


async def test_each_client_is_a_port(server: TcpServer, connect: Connect) -> None:
    """What one client says is that client's, and what is written to one goes to no other."""
    first, second = connect(), connect()
    server.on_acceptable(now=0.0)
    ports = {port.name: port for port in server.ports}
    assert set(ports) == {str(Address(*each.getsockname())) for each in (first, second)}
    second.sendall(frame(2))
    server.start()
    await eventually(lambda: recorder(server).heard == [frame(2)])
    for number, program in enumerate((first, second)):
        port = ports[str(Address(*program.getsockname()))]
        assert (port.heard_at is not None) == (program is second)
        write(server, port, [frame(10 + number)], monotonic())
        assert program.recv(100) == frame(10 + number)
    first.close()
    await eventually(lambda: len(server.ports) == 1)
    assert [port.name for port in server.ports] == [str(Address(*second.getsockname()))]


async def test_a_stray_start_holds_frames_back_no_longer_than_two_seconds(
    server: TcpServer, connect: Connect
) -> None:
    """Not until the sender says more. A serial line behind a server may have one; what TCP has to repeat has time."""
    program = connect()
    server.on_acceptable(now=0.0)
    server.start()
    program.sendall(b"\xfe\xff" + frame(1))
    await eventually(lambda: server.bytes_received == 2 + len(frame(1)))
    server.do_housekeeping(monotonic() + MAX_GAP_S - 1.0)
    assert recorder(server).heard == []
    server.do_housekeeping(monotonic() + MAX_GAP_S)
    assert recorder(server).heard == [frame(1)]


async def test_newcomer_is_turned_away_while_all_places_are_in_use(server: TcpServer, connect: Connect) -> None:
    """The bound holds, and who is there stays there."""
    for _ in range(CLIENTS_PER_ENDPOINT):
        connect()
        server.on_acceptable(now=100.0)
    there = list(server.ports)
    newcomer = connect()
    server.on_acceptable(now=100.0 + CLIENT_QUIET_S - 0.01)
    assert newcomer.recv(1) == b""
    assert list(server.ports) == there
    assert len(there) == CLIENTS_PER_ENDPOINT
    assert server.failures == {"too_many_clients": 1}


async def test_newcomer_takes_the_place_of_the_quietest(server: TcpServer, connect: Connect) -> None:
    """Connections that are never used cannot lock others out: a client that speaks is one that is in use."""
    programs = [connect() for _ in range(CLIENTS_PER_ENDPOINT)]
    for at in range(2):  # the kernel's queue of who waits is as long as there are places
        server.on_acceptable(now=100.0 + at)
    there = list(server.ports)
    speaks = next(each for each in programs if str(Address(*each.getsockname())) == there[0].name)
    speaks.sendall(frame(1))
    server._connections[there[0]].on_readable(now=104.0)
    newcomer = connect()
    server.on_acceptable(now=100.0 + CLIENT_QUIET_S)
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
async def test_browser_is_turned_away(server: TcpServer, connect: Connect, request_line: bytes) -> None:
    """A web page can make a browser post frames to a local port: they are not heard, wherever they stand."""
    server.start()
    program = connect()
    program.sendall(request_line + b"Host: localhost\r\n\r\n" + 20 * frame(1))
    await eventually(lambda: server.failures["http"] == 1)
    await eventually(lambda: bool(recorder(server).closed))
    assert recorder(server).heard == []


async def test_text_of_an_autopilot_is_not_a_browser(server: TcpServer, connect: Connect) -> None:
    """Boot messages, and words of HTTP later on, are bytes like others."""
    server.start()
    program = connect()
    program.sendall(b"Init ArduCopter\r\n" + frame(1))
    await eventually(lambda: recorder(server).heard == [frame(1)])
    program.sendall(b"GET " + frame(2))
    await eventually(lambda: recorder(server).heard == [frame(1), frame(2)])
    assert server.failures.total() == 0


async def test_without_file_descriptors_the_server_waits(
    server: TcpServer, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who cannot be let in is let in later, and the event loop does not spin until then."""
    monkeypatch.setattr(tcp, "ACCEPT_PAUSE_S", 0.05)
    connect()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket() as lowest_free:
        bound = lowest_free.fileno()
    resource.setrlimit(resource.RLIMIT_NOFILE, (bound, hard))
    try:
        server.start()
        await eventually(lambda: server.failures["EMFILE"] > 0)
        for _ in range(100):
            await asyncio.sleep(0)
        assert server.failures["EMFILE"] == 1
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    await eventually(lambda: len(server.ports) == 1)


# A slow or dead client.


def never_read(connect: Connect) -> socket.socket:
    program = connect()
    program.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    return program


async def test_client_that_never_reads_holds_nobody_up(server: TcpServer, connect: Connect) -> None:
    """Another endpoint's program gets the same frames, and none of them noticeably later."""
    alone = await measure_udp_delivery()
    server.start()
    for _ in range(3):
        never_read(connect)
    await eventually(lambda: len(server.ports) == 3)
    beside = await measure_udp_delivery(server)
    assert server.failures["outgoing_full"] > 0
    assert beside.frames == alone.frames
    assert len(beside.frames) == beside.sent
    assert beside.slowest_s < alone.slowest_s + 0.1


async def test_kernel_holds_little_for_a_client_that_never_reads(server: TcpServer, connect: Connect) -> None:
    """Frames that cannot go wait where they can be dropped: what goes to the kernel is a few dozen."""
    server.on_acceptable(0.0)
    program = never_read(connect)
    server.on_acceptable(0.0)
    (port,) = server.ports
    for number in range(2000):
        write(server, port, [large_frame(number)], monotonic())
        await asyncio.sleep(0)
    on_our_side = server.bytes_sent - len(program.recv(1 << 20, socket.MSG_PEEK))
    assert on_our_side < 65536
    connection = server._connections[port]
    not_sent = int.from_bytes(ioctl(connection.channel.fileno(), SIOCOUTQNSD, bytes(4)), sys.byteorder)
    assert not_sent < 1024 + 1400
    waiting = len(connection.outgoing)
    assert server.frames_sent + server.failures["outgoing_full"] + server.failures["stale"] + waiting == 2000


async def test_client_that_never_reads_is_closed_in_the_end(server: TcpServer, connect: Connect) -> None:
    """Its frames get stale first; after half a minute without progress it is gone, with what the kernel held."""
    program = never_read(connect)
    server.on_acceptable(now=100.0)
    (port,) = server.ports
    write(server, port, [large_frame(number) for number in range(200)], now=100.0)
    while not server._connections[port]._awaits_writable:
        write(server, port, [large_frame(0)], now=100.0)
    waiting = server._connections[port].outgoing.waiting
    server.do_housekeeping(now=100.0 + MAX_AGE_S)
    assert server.failures["stale"] == 0
    server.do_housekeeping(now=100.0 + MAX_AGE_S + 0.01)
    assert server.failures["stale"] == waiting  # what is committed has no age
    server.do_housekeeping(now=100.0 + STALLED_S - 0.01)
    assert recorder(server).closed == []
    server.do_housekeeping(now=100.0 + STALLED_S)
    await eventually(lambda: recorder(server).closed == [port])
    assert server.failures["stalled"] == 1
    with pytest.raises(ConnectionResetError):
        read_to_the_end(program)


def read_to_the_end(program: socket.socket) -> None:
    while program.recv(65536):
        pass


# Connecting.


@pytest.fixture
async def client(server: TcpServer) -> AsyncIterator[TcpClient]:
    """A client of the server, not yet started."""
    endpoint = TcpClient("client", Address(*server.address), Recorder())
    yield endpoint
    endpoint.close()


async def test_frames_go_both_ways(server: TcpServer, client: TcpClient) -> None:
    """Both kinds of endpoint are each other's programs."""
    server.start()
    client.start()
    await eventually(lambda: len(server.ports) == len(client.ports) == 1)
    assert client.ports[0].name == str(Address(*server.address))
    write(client, client.ports[0], [frame(1), frame(2)], monotonic())
    write(server, server.ports[0], [frame(3)], monotonic())
    await eventually(lambda: recorder(server).heard == [frame(1), frame(2)] and recorder(client).heard == [frame(3)])


async def test_client_waits_for_a_server_that_is_not_there_yet() -> None:
    """A server that starts late is found, and until then nothing is there to write to."""
    address = unused_address()
    client = TcpClient("client", address, Recorder())
    client.start()
    try:
        with capture_logs() as logs:
            await eventually(lambda: client.failures["ECONNREFUSED"] >= 3)
        (line,) = logs  # not one a try
        assert (line["event"], line["log_level"]) == ("endpoint_not_open", "warning")
        assert (line["endpoint"], line["reason"], line["meaning"]) == (
            "client",
            "ECONNREFUSED",
            "nobody listens there now",
        )
        assert list(client.ports) == []
        with capture_logs() as logs:
            with tcp_listener(address):
                await eventually(lambda: len(client.ports) == 1)
            tried = client.failures["ECONNREFUSED"]
            await eventually(lambda: client.failures["ECONNREFUSED"] > tried)
        assert logs == []  # it was open for a moment only
    finally:
        client.close()


async def test_client_follows_a_server_that_restarts(server: TcpServer, client: TcpClient) -> None:
    """The port is reported as gone and as a new one, within the second for a server that had spoken."""
    server.start()
    client.start()
    await eventually(lambda: len(server.ports) == 1)
    write(server, server.ports[0], [frame(1)], monotonic())
    await eventually(lambda: recorder(client).heard == [frame(1)])
    (before,) = client.ports
    address = Address(*server.address)
    server.close()
    await eventually(lambda: recorder(client).closed == [before])
    again = TcpServer("again", tcp_listener(address), Recorder())
    again.start()
    began = monotonic()
    try:
        await eventually(lambda: len(again.ports) == 1)
        assert monotonic() - began < 1.0
        write(again, again.ports[0], [frame(2)], monotonic())
        await eventually(lambda: recorder(client).heard == [frame(1), frame(2)])
        assert client.ports[0] is not before
    finally:
        again.close()


async def test_waits_grow_where_a_server_only_accepts_and_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each wait is twice the one before up to the longest, though every attempt connects."""
    waits: list[float] = []
    sleep = asyncio.sleep

    async def short(delay: float) -> None:
        waits.append(delay)
        await sleep(0)

    def accept_and_close() -> None:
        listener.accept()[0].close()

    listener = tcp_listener(ANY_PORT)
    asyncio.get_running_loop().add_reader(listener, accept_and_close)
    client = TcpClient("client", Address(*listener.getsockname()), Recorder())
    with monkeypatch.context() as patched:
        patched.setattr(asyncio, "sleep", short)
        client.start()
        while len(waits) < 8:
            await sleep(0)
        client.close()
    asyncio.get_running_loop().remove_reader(listener)
    listener.close()
    for wait_s, least_s in zip(waits, [0.25, 0.5, 1.0, 2.0, 4.0, 5.0, 5.0, 5.0], strict=False):
        assert least_s <= wait_s <= 1.25 * least_s


async def test_name_is_looked_up_at_each_attempt(server: TcpServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """An autopilot that got another address is found there."""
    server.start()
    asked: list[tuple[str, int]] = []
    elsewhere = unused_address()

    def look_up(host: str, port: int, **_: object) -> list[tuple[object, ...]]:
        asked.append((host, port))
        if len(asked) == 1:
            raise socket.gaierror(socket.EAI_NONAME, "unknown")
        sockaddr = elsewhere.sockaddr if len(asked) == 2 else server.address
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", sockaddr)]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    client = TcpClient("client", Address("autopilot.test", 5760), Recorder())
    client.start()
    try:
        await eventually(lambda: len(client.ports) == 1)
        assert asked == [("autopilot.test", 5760)] * 3
        assert client.failures == {"not_resolved": 1, "ECONNREFUSED": 1}
        assert client.ports[0].name == "autopilot.test:5760"
    finally:
        client.close()


async def test_next_address_of_a_name_is_tried(server: TcpServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name with an address that does not answer, or is of a family that is not there, has others."""
    server.start()
    found = [
        (socket.AF_INET, socket.SOCK_STREAM, 6, "", unused_address().sockaddr),
        (12345, socket.SOCK_STREAM, 6, "", ("::1", 1, 0, 0)),
        (socket.AF_INET, socket.SOCK_STREAM, 6, "", server.address),
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    client = TcpClient("client", Address("autopilot.test", 5760), Recorder())
    client.start()
    try:
        await eventually(lambda: len(client.ports) == 1)
        assert client.failures == {"ECONNREFUSED": 1, "EAFNOSUPPORT": 1}
    finally:
        client.close()


async def test_address_that_does_not_answer_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither answer nor refusal: a firewall, or a machine that is off."""
    monkeypatch.setattr(tcp, "CONNECT_TIMEOUT_S", 0.05)
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        deaf.listen(0)
        with socket.create_connection(
            deaf.getsockname()
        ):  # the one place in the queue of a listener who never accepts
            client = TcpClient("client", Address(*deaf.getsockname()), Recorder())
            client.start()
            await eventually(lambda: client.failures["connect_timeout"] > 0)
            client.close()
    assert client.failures.keys() == {"connect_timeout"}


async def test_connection_to_oneself_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nobody listens the kernel may pick the same port for our side, and TCP then meets itself."""
    address = unused_address()
    prepare = tcp._prepare

    def prepare_there(sock: socket.socket) -> None:
        prepare(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address.sockaddr)

    monkeypatch.setattr(tcp, "_prepare", prepare_there)
    client = TcpClient("client", address, Recorder())
    client.start()
    await eventually(lambda: client.failures["ECONNREFUSED"] > 0)
    assert recorder(client).open == []
    client.close()


async def test_sockets_hold_little_and_notice_the_end(server: TcpServer, client: TcpClient) -> None:
    """Both sides send at once, keep little, and ask whether the other side is still there."""
    server.start()
    client.start()
    await eventually(lambda: len(server.ports) == len(client.ports) == 1)
    for endpoint in (server, client):
        (connection,) = endpoint._connections.values()
        assert not os.get_blocking(connection.channel.fileno())
        with socket.socket(fileno=os.dup(connection.channel.fileno())) as sock:
            assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1
            assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
            assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 32768


async def test_closed_client_leaves_nothing_behind(client: TcpClient) -> None:
    """Closed before it was started, while it connects or while it waits: no port, and no socket (a warning here)."""
    client.start()
    await asyncio.sleep(0)
    client.close()
    await asyncio.sleep(0)
    assert list(client.ports) == []
    assert recorder(client).open == []
