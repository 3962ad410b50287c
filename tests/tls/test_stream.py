"""Datagrams in WebSocket messages over TLS and plain TCP, on both event loops: whole, in order, never piled up."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import socket
import ssl
import struct
from array import array
from collections.abc import AsyncIterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, cast

import pytest
import uvloop

from tests.tls.web_streams import REQUEST, Loopback, frame
from tests.waiting import until
from uavlinkd.io import send_window
from uavlinkd.system.clock import monotonic
from uavlinkd.tls import channel as tls_channel
from uavlinkd.tls import stream as web_stream
from uavlinkd.tls.channel import TlsChannel, server_context
from uavlinkd.tls.stream import GATHER_BYTES, MAX_MESSAGE, QUEUE_BYTES

DATAGRAM = bytes(range(200))
TURNS = 300
pytestmark = pytest.mark.filterwarnings("ignore:Overriding the .event_loop_policy. fixture")


@pytest.fixture(params=[asyncio.DefaultEventLoopPolicy, uvloop.EventLoopPolicy], ids=["asyncio", "uvloop"])
def event_loop_policy(request: pytest.FixtureRequest) -> asyncio.AbstractEventLoopPolicy:
    """Each test runs on both loops."""
    policy: asyncio.AbstractEventLoopPolicy = request.param()
    return policy


@pytest.fixture(params=["tls", "plain"])
async def loopback(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Loopback]:
    """With TLS, and without."""
    with closing(Loopback(tmp_path if request.param == "tls" else None)) as made:
        yield made


@pytest.fixture
async def plain() -> AsyncIterator[Loopback]:
    """Without TLS."""
    with closing(Loopback(None)) as made:
        yield made


@pytest.fixture
async def secure(tmp_path: Path) -> AsyncIterator[Loopback]:
    """With TLS."""
    with closing(Loopback(tmp_path)) as made:
        yield made


async def turns() -> None:
    """The event loop looks at its sockets in each turn."""
    for _ in range(TURNS):
        await asyncio.sleep(0)


async def test_datagrams_arrive_whole_and_in_order(loopback: Loopback) -> None:
    """In both directions, of any size up to the limit; the datagrams of one turn arrive together."""
    member, relay = await loopback.pair()
    sent = [b"", b"\0", bytes(range(256)), bytes(MAX_MESSAGE), *(bytes([number]) * number for number in range(60))]
    for datagram in sent:
        member.stream.send(datagram)
        relay.stream.send(datagram[::-1])
    await until(lambda: len(member.datagrams) == len(relay.datagrams) == len(sent))
    assert relay.datagrams == sent
    assert member.datagrams == [datagram[::-1] for datagram in sent]
    assert all(type(datagram) is bytes for datagram in relay.datagrams)
    assert len(relay.batches) < len(sent) / 2
    assert member.stream._channel.bytes_sent > sum(map(len, sent))
    assert relay.stream.request is not None
    assert relay.stream.request.headers["Host"] == "relay.example.org"


async def test_an_owner_that_waits_for_room_loses_no_datagram(loopback: Loopback) -> None:
    """Beyond the first window, so Pongs open it again."""
    member, relay = await loopback.pair()
    sent = member.fill(DATAGRAM)
    assert 1 <= sent <= GATHER_BYTES // len(DATAGRAM) + 1
    while sent < 2000:
        await until(lambda: member.stream.room(monotonic()) > 0)
        sent += member.fill(DATAGRAM)
    await until(lambda: len(relay.datagrams) == sent)
    assert member.stream.dropped == 0
    assert (member.reasons, relay.reasons) == ([], [])


def unsent_bytes(sock: socket.socket) -> int:
    count = array("i", [0])
    fcntl.ioctl(sock, tls_channel._SIOCOUTQNSD, count)
    return count[0]


async def test_a_receiver_that_does_not_read(loopback: Loopback, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel holds a segment, old datagrams are dropped, and the loop sleeps until there is room again."""
    for limit in ("FIRST_BYTES", "LEAST_BYTES"):
        monkeypatch.setattr(send_window, limit, 1 << 30)
    wake_ups = 0
    on_writable = TlsChannel._on_writable

    def counted(channel: TlsChannel) -> None:
        nonlocal wake_ups
        wake_ups += 1
        on_writable(channel)

    monkeypatch.setattr(TlsChannel, "_on_writable", counted)
    loopback.listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock = await loopback.raw()
    member, relay = loopback.member(sock), loopback.relay(await loopback.accepted())
    await until(lambda: bool(member.opened and relay.opened))
    loop, fd = asyncio.get_running_loop(), relay.stream._channel._fd
    loop.remove_reader(fd)
    before, sent = -1, 0
    while before < wake_ups or unsent_bytes(sock) < tls_channel.UNSENT_BYTES:  # the kernel paces what it sends
        before = wake_ups
        sent += member.fill(DATAGRAM)
        await asyncio.sleep(0.1)
    assert unsent_bytes(sock) < tls_channel.UNSENT_BYTES + 2 * GATHER_BYTES
    before = wake_ups
    await turns()
    assert wake_ups <= before + 1

    while not member.stream.dropped:
        with suppress(OSError):  # ENOBUFS, when one was dropped
            member.stream.send(DATAGRAM)
        sent += 1
        await asyncio.sleep(0.01)
    assert member.stream._queued_bytes < QUEUE_BYTES / 2, "dropped by age"
    for _ in range(2 * QUEUE_BYTES // len(DATAGRAM)):
        with suppress(OSError):
            member.stream.send(DATAGRAM)
        sent += 1
    assert sum(len(datagram) for datagram, _ in member.stream._queue) <= QUEUE_BYTES

    assert member.stream.room(monotonic()) == 0
    loop.add_reader(fd, relay.stream._channel._on_readable)
    await until(lambda: member.stream.room(monotonic()) > 0)
    member.stream.send(b"last")
    await until(lambda: relay.datagrams[-1:] == [b"last"])
    assert len(relay.datagrams) + member.stream.dropped == sent + 1


async def test_sending_ends_with_the_stream(plain: Loopback) -> None:
    """The owner is informed once."""
    member, relay = await plain.pair()
    with pytest.raises(OSError, match="longer") as raised:
        member.stream.send(bytes(MAX_MESSAGE + 1))
    assert raised.value.errno == errno.EMSGSIZE
    member.stream.lose("here")
    member.stream.lose("again")
    with pytest.raises(OSError, match="not open") as raised:
        member.stream.send(b"")
    assert raised.value.errno == errno.ENOTCONN
    assert member.stream.room(monotonic()) == 0
    await until(lambda: relay.reasons == ["closed"])
    assert member.reasons == ["here"]


async def test_window_closes_without_pongs(plain: Loopback, monkeypatch: pytest.MonkeyPatch) -> None:
    """A proxy that takes bytes and delivers nothing: the window closes, and then the stream is lost."""
    sock = await plain.raw()
    relay = plain.relay(await plain.accepted())
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(sock, REQUEST)
    await until(lambda: relay.opened == 1)
    loop.add_reader(sock, lambda: sock.recv(65536))
    sent = 0
    while count := relay.fill(DATAGRAM):
        sent += count
        await asyncio.sleep(0)
        await until(lambda: relay.stream.room(monotonic()) > 0 or not relay.stream._window.is_open)
    assert send_window.FIRST_BYTES < sent * (len(DATAGRAM) + 4) < send_window.FIRST_BYTES + 2 * GATHER_BYTES
    relay.stream.send(b"waits")
    monkeypatch.setattr(send_window, "PONG_S", 0.0)
    relay.stream.room(monotonic())
    await until(lambda: relay.reasons == ["no_pong"])
    loop.remove_reader(sock)


OPENED = [
    (frame(1, b"text"), "text"),
    (frame(2, b"part", fin=False), "fragment"),
    (frame(0, b"part"), "protocol"),
    (frame(2, bytes(MAX_MESSAGE + 1)), "long_message"),
    (frame(2, bytes(70_000))[:20], "long_message"),
    (frame(2, b"", masked=False), "protocol"),
    (frame(3, b""), "protocol"),
    (frame(9, bytes(126)), "protocol"),
    (frame(8, b"\x03\xe8"), "closed"),
    (frame(8, b"\x00"), "protocol"),
    (frame(9, b"") * 100, "pings"),
    (frame(10, b"") * 100, "pings"),
    (frame(2, b"") * 100, "pings"),
    (frame(2, b"12 bytes, no") * 100, "pings"),
    (b"\xff" * 100, "protocol"),
]


@pytest.mark.parametrize(("data", "reason"), OPENED)
async def test_hostile_messages_end_the_connection(plain: Loopback, data: bytes, reason: str) -> None:
    """With a name of the fault; what came before it is delivered, and the other connection goes on."""
    member, other = await plain.pair()
    sock = await plain.raw()
    relay = plain.relay(await plain.accepted())
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(sock, REQUEST)
    await until(lambda: relay.opened == 1)
    await loop.sock_sendall(sock, frame(2, b"before") + data + frame(2, b"after"))
    await until(lambda: relay.reasons == [reason])
    assert relay.datagrams[:1] == [b"before"]
    assert reason == "pings" or len(relay.datagrams) == 1
    member.stream.send(b"goes on")
    await until(lambda: other.datagrams == [b"goes on"])


async def test_fault_ends_a_read(plain: Loopback) -> None:
    """What follows it costs no time, and is not delivered."""
    sock = await plain.raw()
    relay = plain.relay(await plain.accepted())
    await asyncio.get_running_loop().sock_sendall(sock, REQUEST + frame(2, b"") * 2500)
    await until(lambda: relay.reasons in (["pings"], ["protocol"]))
    assert len(relay.datagrams) < 500


async def test_tls_that_cannot_write_ends_the_connection(secure: Loopback) -> None:
    """The other end began a handshake of TLS again, and waits."""

    class Waiting:
        def write(self, data: bytes) -> int:
            raise ssl.SSLWantReadError

    member, _ = await secure.pair()
    member.stream._channel._tls = cast(Any, Waiting())
    member.stream.send(DATAGRAM)
    await until(lambda: member.reasons == ["tls"])


@pytest.mark.parametrize(
    ("data", "reason", "answer"),
    [
        (b"GET /other HTTP/1.1\r\n\r\n", "wrong_path", b"404"),
        (b"GET /uavlink HTTP/1.1\r\n\r\n", "not_websocket", b"426"),
        (b"POST /uavlink HTTP/1.1\r\n\r\n", "not_websocket", b""),
        (b"GET /uavlink HTTP/1.1\r\nContent-Length: 9\r\n\r\n", "not_websocket", b""),
        (b"\x16\x03\x01\x02\x00\x01\x00\r\n", "not_websocket", b""),
        (b"GET /" + b"a" * 9000, "long_header", b""),
        (b"GET / HTTP/1.1\r\n" + b"a: " + b"b" * 9000, "long_header", b""),
        (b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 200, "long_header", b"431"),
        (REQUEST[:-2] + b"a: " + b"b" * 4000 + b"\r\nc: " + b"d" * 4200, "long_header", b""),
        (REQUEST + frame(2, b"early"), "protocol", b""),
        (REQUEST + b"\xff\xff", "protocol", b""),
        (b"GET / HTTP/1.1\r\n\r\n\xff\xff", "protocol", b""),
        (REQUEST[:40], "slow_handshake", b""),
        (b"", "slow_handshake", b""),
    ],
)
async def test_hostile_requests(
    plain: Loopback, data: bytes, reason: str, answer: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each ends with a name, and HTTP's answer."""
    if reason == "slow_handshake":
        monkeypatch.setattr(web_stream, "OPEN_S", 0.05)
    sock = await plain.raw()
    relay = plain.relay(await plain.accepted())
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(sock, data)
    await until(lambda: relay.reasons == [reason])
    if answer:
        assert answer in await loop.sock_recv(sock, 4096)
    assert (relay.opened, relay.datagrams) == (0, [])


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 2\r\n\r\nno", "http_404"),
        (b"HTTP/1.1 502 Bad Gateway\r\n\r\nno length", "http_502"),
        (b"HTTP/1.1 101 Switching Protocols\r\n\r\n", "not_websocket"),
        (b"SSH-2.0-OpenSSH\r\n\r\n", "not_websocket"),
        (b"HTTP/1.1 200 OK\r\n\r\n" + b"endless" * 2000, "long_header"),
        (b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * 200, "not_websocket"),
        (b"", "closed"),
    ],
)
async def test_hostile_responses(plain: Loopback, data: bytes, reason: str) -> None:
    """Of what is not a relay."""
    sock = await plain.raw()
    other = await plain.accepted()
    other.setblocking(False)
    member = plain.member(sock)
    loop = asyncio.get_running_loop()
    assert (await loop.sock_recv(other, 4096)).startswith(b"GET /uavlink HTTP/1.1\r\n")
    await loop.sock_sendall(other, data)
    other.shutdown(socket.SHUT_WR)
    await until(lambda: member.reasons == [reason])
    assert member.opened == 0


async def test_garbage_in_place_of_tls(secure: Loopback) -> None:
    """At a relay and at a member; and a member whose TLS is refused."""
    sock = await secure.raw()
    relay = secure.relay(await secure.accepted())
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(sock, REQUEST)
    await until(lambda: relay.reasons == ["tls"])
    sock = await secure.raw()
    other = await secure.accepted()
    other.setblocking(False)
    member = secure.member(sock)
    await loop.sock_sendall(other, b"HTTP/1.1 400 Bad Request\r\n\r\n")
    await until(lambda: member.reasons == ["tls"])


async def test_damaged_record_ends_the_connection(secure: Loopback) -> None:
    """As a proxy may alter it: no byte of it is delivered."""
    member, relay = await secure.pair()
    member.stream._channel._rest += b"\x17\x03\x03\x00\x20" + bytes(32)
    member.stream.send(DATAGRAM)
    member.stream._channel._pass_on()
    await until(lambda: relay.reasons == ["tls"])
    assert relay.datagrams == []
    await until(lambda: member.reasons != [])


async def test_reset(loopback: Loopback) -> None:
    """The kernel's name; also for a connection that is reset before the relay looks."""
    member, relay = await loopback.pair()
    sock = member.stream._channel._sock
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    member.stream.lose("reset")
    await until(lambda: relay.reasons == ["ECONNRESET"])
    raw = await loopback.raw()
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    raw.close()
    relay = loopback.relay(await loopback.accepted())
    await until(lambda: relay.reasons == ["ECONNRESET"])


async def test_datagrams_from_before_a_pause_are_dropped(plain: Loopback) -> None:
    """Counted by the name of the sender."""
    member, relay = await plain.pair()
    loop, channel = asyncio.get_running_loop(), relay.stream._channel
    loop.remove_reader(channel._fd)
    sent = member.stream._channel.bytes_sent
    member.stream.send(b"old")
    await until(lambda: member.stream._channel.bytes_sent > sent)
    plain.stall.turned_at -= 100
    channel._on_readable()
    assert (relay.datagrams, plain.stall.dropped["members"]) == ([], 1)
    loop.add_reader(channel._fd, channel._on_readable)
    member.stream.send(b"new")
    await until(lambda: relay.datagrams == [b"new"])


def test_certificate_that_cannot_be_used(tmp_path: Path) -> None:
    """An OSError says so."""
    (tmp_path / "cert.pem").write_text("not a certificate")
    with pytest.raises(OSError, match="PEM"):
        server_context(str(tmp_path / "cert.pem"), str(tmp_path / "cert.pem"))
    with pytest.raises(FileNotFoundError):
        server_context(str(tmp_path / "none.pem"), str(tmp_path / "none.pem"))
