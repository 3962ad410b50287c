"""Clients of ``udpin`` that have gone: they are forgotten, and cost other clients neither frames nor time."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

import pytest
import uvloop

from tests.daemon.udp import open_socket
from tests.endpoints.clients import PASSES, Recorder, frame, frames_of, heartbeat, write
from tests.needs import need
from tests.waiting import until
from uavlinkd.endpoints.error_queue import SEND_ATTEMPTS
from uavlinkd.endpoints.ports import LocalPort
from uavlinkd.endpoints.sockets import udp_socket
from uavlinkd.endpoints.udp import CLIENT_SILENT_S, UdpServer
from uavlinkd.lab.sim.loopback_ports import has_ipv6
from uavlinkd.link.switch import Switch
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.routing import Router
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch

LOOPS = pytest.mark.parametrize("new_loop", [asyncio.SelectorEventLoop, uvloop.new_event_loop])
NewLoop = Callable[[], asyncio.AbstractEventLoop]


class CountingSocket:
    """A socket that counts the datagrams that it sends."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self.sent = 0
        self.fails_with: list[int] = []

    def sendto(self, datagram: bytes, address: Any) -> int:
        self.sent += 1
        if self.fails_with:
            raise OSError(self.fails_with.pop(), "injected")
        return self._sock.sendto(datagram, address)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sock, name)


class Hub:
    """An endpoint whose clients reach each other through a switch, as in the daemon."""

    def __init__(self, host: str = "127.0.0.1") -> None:
        self.host = host
        self.stall = StallWatch(monotonic(), lambda seconds: None)
        self.switch = Switch(Router[Any](), lambda *arguments, **options: None)
        self.sock = CountingSocket(udp_socket(Address(host, 0)))
        self.endpoint = UdpServer("clients", cast(socket.socket, self.sock), self)
        self.clients: list[socket.socket] = []

    def on_port_opened(self, port: LocalPort) -> None:
        self.switch.add(port, compile_policy({}, is_local=True))

    def on_port_closed(self, port: LocalPort) -> None:
        self.switch.remove(port)

    def on_port_silent(self, port: LocalPort) -> None:
        self.switch.set_silent(port, is_silent=True)

    def on_port_active(self, port: LocalPort) -> None:
        self.switch.set_silent(port, is_silent=False)

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        self.switch.forward(port, frames, now, waited_s)

    async def connect(self) -> socket.socket:
        """A client that has sent a frame."""
        client = open_socket(self.host)
        client.connect(self.endpoint._sock.getsockname())
        self.clients.append(client)
        await self.send(client, heartbeat())
        return client

    async def send(self, client: socket.socket, raw: bytes) -> None:
        """Send a frame, and wait until the endpoint has forwarded it."""
        before = self.endpoint.counters.frames
        client.send(raw)
        await until(lambda: self.endpoint.counters.frames > before)

    async def __aenter__(self) -> Hub:
        self.endpoint.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.endpoint.close()
        for client in self.clients:
            client.close()


def received(client: socket.socket) -> list[bytes]:
    """Everything that waits in a client's socket."""
    datagrams = []
    while True:
        try:
            datagrams.append(client.recv(65536))
        except BlockingIOError:
            return datagrams


@LOOPS
@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_forty_restarts_of_a_client_do_not_add_work_per_frame(new_loop: NewLoop, host: str) -> None:
    """Each restart has a new port. The old port refuses the next datagram, and gets no other."""
    need(host != "::1" or has_ipv6(), "an IPv6 loopback")

    async def run() -> None:
        async with Hub(host) as hub:
            sender, receiver = await hub.connect(), await hub.connect()
            closed = set()  # the kernel may choose the same port again
            for _ in range(40):
                client = await hub.connect()
                closed.add(client.getsockname())
                client.close()
                await hub.send(sender, frame(0))
            await until(lambda: len(hub.endpoint.ports) == 2)
            received(receiver)
            hub.sock.sent = 0
            for number in range(100):
                await hub.send(sender, frame(1000 + number))
            assert hub.sock.sent == 100
            assert received(receiver) == [frame(1000 + number) for number in range(100)]
            assert hub.endpoint.failures["ECONNREFUSED"] >= len(closed) > 20
            assert set(hub.endpoint.failures) == {"ECONNREFUSED"}

    with asyncio.Runner(loop_factory=new_loop) as runner:
        runner.run(run())


@LOOPS
def test_a_pending_error_costs_no_other_client_a_frame(new_loop: NewLoop) -> None:
    """The kernel reports a refusal at the next call on the socket, also when that sends to another client."""

    async def run() -> None:
        async with Hub() as hub:
            gone, receiver = await hub.connect(), await hub.connect()
            received(receiver)
            of_gone, of_receiver = hub.endpoint.ports
            gone.close()
            for number in range(10):
                write(hub.endpoint, of_gone, [frame(number)], 1.0)
                write(hub.endpoint, of_receiver, [frame(number)], 1.0)
            assert received(receiver) == [frame(number) for number in range(10)]
            assert hub.endpoint.ports == [of_gone, of_receiver], "not forgotten within a write"
            await until(lambda: hub.endpoint.ports == [of_receiver])
            await hub.send(receiver, frame(1))

    with asyncio.Runner(loop_factory=new_loop) as runner:
        runner.run(run())


@LOOPS
def test_frames_are_read_while_errors_are_pending(new_loop: NewLoop) -> None:
    """libuv stops to watch a socket with a pending error. No datagram stays unread."""

    async def run() -> None:
        async with Hub() as hub:
            sender = await hub.connect()
            for number in range(300):
                gone = await hub.connect()
                port = hub.endpoint.ports[-1]
                gone.close()
                write(hub.endpoint, port, [frame(number)], 1.0)
                sender.send(frame(number))
            await until(lambda: hub.endpoint.counters.frames == 601)
            await until(lambda: len(hub.endpoint.ports) == 1)

    with asyncio.Runner(loop_factory=new_loop) as runner:
        runner.run(run())


@pytest.fixture
async def hub() -> AsyncIterator[Hub]:
    """On IPv4, in the loop of the test."""
    async with Hub() as hub:
        yield hub


async def test_a_client_that_comes_back_is_served_again(hub: Hub) -> None:
    """With the same port, as of a ground station that was restarted."""
    client, sender = await hub.connect(), await hub.connect()
    address = client.getsockname()
    client.close()
    await hub.send(sender, frame(1))
    await until(lambda: len(hub.endpoint.ports) == 1)
    again = open_socket("127.0.0.1", address[1])
    again.connect(hub.endpoint.address)
    hub.clients.append(again)
    await hub.send(again, heartbeat())
    await hub.send(sender, frame(2))
    assert received(again) == [frame(2)]


async def test_an_endpoint_that_is_closed_forgets_no_client_after_that() -> None:
    """The daemon has removed the endpoint's ports already."""
    async with Hub() as hub:
        gone = await hub.connect()
        (port,) = hub.endpoint.ports
        gone.close()
        write(hub.endpoint, port, [frame(1), frame(2)], 1.0)
        hub.endpoint._take_errors()
        hub.switch.remove(port)
    await asyncio.sleep(0)


async def test_errors_of_the_send_itself_are_counted_once(hub: Hub) -> None:
    """Without the record of an earlier error there is one more attempt, and none while the send buffer is full."""
    await hub.connect()
    (port,) = hub.endpoint.ports
    for number, sent in ((errno.ENETUNREACH, 2), (errno.EAGAIN, 1)):
        hub.sock.sent, hub.sock.fails_with = 0, [number] * 100
        write(hub.endpoint, port, [frame(1)], 1.0)
        assert (hub.sock.sent, hub.endpoint.failures[errno.errorcode[number]]) == (sent, 1)


async def test_a_pending_error_costs_no_frame_while_the_receive_buffer_is_full(hub: Hub) -> None:
    """The kernel has no room for the record of the error, and reports it at the next call all the same."""
    gone, receiver, flooder = await hub.connect(), await hub.connect(), await hub.connect()
    received(receiver)
    of_gone, of_receiver, _ = hub.endpoint.ports
    gone.close()
    hub.endpoint._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    for _ in range(200):
        flooder.send(bytes(100))
    for number in range(10):
        write(hub.endpoint, of_gone, [frame(number)], 1.0)
        write(hub.endpoint, of_receiver, [frame(number)], 1.0)
    assert received(receiver) == [frame(number) for number in range(10)]


async def test_attempts_to_send_are_bounded(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors that arrive faster than frames do not hold up the loop."""
    await hub.connect()
    (port,) = hub.endpoint.ports
    monkeypatch.setattr(UdpServer, "_take_errors", lambda self: True)
    hub.sock.sent, hub.sock.fails_with = 0, [errno.ECONNREFUSED] * 100
    write(hub.endpoint, port, [frame(1)], 1.0)
    assert hub.sock.sent == 1 + SEND_ATTEMPTS
    assert hub.endpoint.failures == {"ECONNREFUSED": 1}


async def test_other_errors_of_earlier_datagrams_forget_no_client(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """A host that is unreachable now may be reachable again."""
    client = await hub.connect()
    address = client.getsockname()
    errors = [(address, errno.EHOSTUNREACH), (("192.0.2.1", 9), errno.ECONNREFUSED)]
    monkeypatch.setattr("uavlinkd.endpoints.udp.read_error_queue", lambda sock: errors)
    assert hub.endpoint._take_errors()
    await asyncio.sleep(0)
    assert hub.endpoint.failures == {"EHOSTUNREACH": 1, "ECONNREFUSED": 1}
    assert len(hub.endpoint.ports) == 1


async def test_a_read_error_without_an_earlier_datagram_is_counted(hub: Hub) -> None:
    """Such as a lack of memory."""
    hub.endpoint._on_read_error(OSError(errno.ENOMEM, "no memory"))
    assert hub.endpoint.failures == {"ENOMEM": 1}


async def test_a_silent_client_gets_no_broadcasts_of_other_clients(hub: Hub) -> None:
    """It gets them again with its next frame, and meanwhile what others send to its system."""
    silent, sender = await hub.connect(), await hub.connect()
    received(silent)
    hub.endpoint.do_housekeeping(monotonic() + CLIENT_SILENT_S - 1.0)
    await hub.send(sender, frame(1))
    assert received(silent) == [frame(1)]
    of_silent, of_sender = hub.endpoint.ports
    of_sender.received_at = monotonic() + 10.0
    hub.endpoint.do_housekeeping(monotonic() + CLIENT_SILENT_S)
    await hub.send(sender, frame(2))
    assert received(silent) == []
    of_silent.send(frames_of([frame(3)]), PASSES, 1.0, 0.0)
    assert received(silent) == [frame(3)]
    await hub.send(silent, heartbeat())
    await hub.send(sender, frame(4))
    assert received(silent) == [frame(4)]


async def test_silence_is_reported_once() -> None:
    """And its end before the first frame. A client that is forgotten is not silent any more."""
    recorder = Recorder()
    endpoint = UdpServer("clients", udp_socket(Address("127.0.0.1", 0)), recorder)
    address = ("127.0.0.1", 9)
    try:
        endpoint.take([(heartbeat(), address)], 100.0, 0)
        for now, silent in ((104.9, []), (105.0, ["127.0.0.1:9"]), (106.0, ["127.0.0.1:9"])):
            endpoint.do_housekeeping(now)
            assert recorder.silent == silent
        endpoint.take([(heartbeat(), address)], 107.0, 0)
        assert recorder.silent == []
        endpoint.do_housekeeping(112.0)
        endpoint.do_housekeeping(167.0)
        assert (list(endpoint.ports), endpoint._silent) == ([], set())
    finally:
        endpoint.close()
