"""Clients of ``udpin`` that have gone: they are forgotten, and cost other clients neither frames nor time."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator
from contextlib import closing
from typing import Any, cast

import pytest

from tests.io.clients import LOOPS, NewLoop, Recorder, frame, heartbeat, run_in, write
from tests.processes.udp import open_socket
from tests.waiting import until
from uavlinkd.io.sockets import SEND_ATTEMPTS, ErrorReports, udp_socket
from uavlinkd.io.udp import UdpServer
from uavlinkd.system.addresses import Address


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
    """An endpoint and its clients."""

    def __init__(self) -> None:
        self.sock = CountingSocket(udp_socket(Address("127.0.0.1", 0)))
        self.endpoint = UdpServer("clients", cast(socket.socket, self.sock), Recorder())
        self.clients: list[socket.socket] = []

    async def connect(self) -> socket.socket:
        """A client that has sent a frame."""
        client = open_socket("127.0.0.1")
        client.connect(self.endpoint._sock.getsockname())
        self.clients.append(client)
        await self.send(client, heartbeat())
        return client

    async def send(self, client: socket.socket, raw: bytes) -> None:
        """Send a frame, and wait until the endpoint has read it."""
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
def test_a_pending_error_costs_no_other_client_a_frame(new_loop: NewLoop) -> None:
    """The kernel reports a refusal at the next call on the socket, also when that sends to another client."""

    async def run() -> None:
        async with Hub() as hub:
            gone, receiver = await hub.connect(), await hub.connect()
            of_gone, of_receiver = hub.endpoint.ports
            gone.close()
            for number in range(10):
                write(of_gone, [frame(number)], 1.0)
                write(of_receiver, [frame(number)], 1.0)
            assert received(receiver) == [frame(number) for number in range(10)]
            assert hub.endpoint.ports == [of_gone, of_receiver], "not forgotten within a write"
            await until(lambda: hub.endpoint.ports == [of_receiver])
            await hub.send(receiver, frame(1))

    run_in(new_loop, run())


@pytest.fixture
async def hub() -> AsyncIterator[Hub]:
    """On IPv4, in the loop of the test."""
    async with Hub() as hub:
        yield hub


async def test_attempts_to_send_are_bounded(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors that arrive faster than frames do not hold up the loop."""
    await hub.connect()
    (port,) = hub.endpoint.ports
    monkeypatch.setattr(UdpServer, "_take_errors", lambda self: True)
    hub.sock.sent, hub.sock.fails_with = 0, [errno.ECONNREFUSED] * 100
    write(port, [frame(1)], 1.0)
    assert hub.sock.sent == 1 + SEND_ATTEMPTS
    assert hub.endpoint.failures == {"ECONNREFUSED": 1}


async def test_other_errors_of_earlier_datagrams_forget_no_client(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """A host that is unreachable now may be reachable again."""
    client = await hub.connect()
    address = client.getsockname()
    errors = [(address, errno.EHOSTUNREACH), (("192.0.2.1", 9), errno.ECONNREFUSED)]
    monkeypatch.setattr(ErrorReports, "take", lambda reports: errors)
    assert hub.endpoint._take_errors()
    await asyncio.sleep(0)
    assert hub.endpoint.failures == {"EHOSTUNREACH": 1, "ECONNREFUSED": 1}
    assert len(hub.endpoint.ports) == 1


async def test_silence_is_reported_once() -> None:
    """And its end before the first frame. A client that is forgotten is not silent any more."""
    recorder = Recorder()
    address = ("127.0.0.1", 9)
    with closing(UdpServer("clients", udp_socket(Address("127.0.0.1", 0)), recorder)) as endpoint:
        endpoint.take([(heartbeat(), address)], 100.0, 0)
        for now, silent in ((104.9, []), (105.0, ["127.0.0.1:9"]), (106.0, ["127.0.0.1:9"])):
            endpoint.do_housekeeping(now)
            assert recorder.silent == silent
        endpoint.take([(heartbeat(), address)], 107.0, 0)
        assert recorder.silent == []
        endpoint.do_housekeeping(112.0)
        endpoint.do_housekeeping(167.0)
        assert (list(endpoint.ports), endpoint._silent) == ([], set())
