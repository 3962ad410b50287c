"""``udpout`` endpoints: which of the client's addresses is used, and which senders are its client."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.io.clients import Recorder, address_of, frame, heartbeat, write
from tests.processes.udp import open_socket
from tests.waiting import until
from uavlinkd.io import resolver
from uavlinkd.io.udp import ATTEMPT_S, AVOIDED_S, REMOTE_SILENT_S, UdpClient
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic

FIRST, SECOND = "127.0.0.2", "127.0.0.3"


class Named:
    """A ``udpout`` to a name with two addresses, and its client, which listens at some of them."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.recorder = Recorder()
        self.endpoint = UdpClient("ground", Address("ground.test", port), self.recorder)
        self.stack = ExitStack()

    def listen(self, host: str) -> socket.socket:
        return self.stack.enter_context(open_socket(host, self.port))

    @property
    def used(self) -> str:
        (port,) = self.endpoint.ports
        return port.name.partition(":")[0]

    def send(self, number: int) -> None:
        write(self.endpoint.ports[0], [frame(number)], monotonic())

    async def answer(self, client: socket.socket) -> None:
        before = self.endpoint.counters.frames
        client.sendto(heartbeat(), ("127.0.0.1", address_of(self.endpoint)[1]))
        await until(lambda: self.endpoint.counters.frames > before)


@pytest.fixture
async def named(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Named]:
    def look_up(address: Address, flags: int) -> list[Any]:
        return [(socket.AF_INET, (host, address.port)) for host in (FIRST, SECOND)]

    monkeypatch.setattr(resolver, "_look_up", look_up)
    named = Named(free_port())
    named.endpoint.start()
    await until(lambda: bool(named.endpoint.ports))
    yield named
    named.endpoint.close()
    named.stack.close()


async def test_next_address_is_used_if_the_first_is_dead(named: Named) -> None:
    """The client has one connection all the time. A dead address is avoided, also if the client only listens."""
    listener = named.listen(SECOND)
    assert named.used == FIRST
    named.send(1)
    await until(lambda: named.endpoint.failures["ECONNREFUSED"] > 0)
    for later in (ATTEMPT_S, 2 * REMOTE_SILENT_S, AVOIDED_S - 1.0):
        named.endpoint.do_housekeeping(monotonic() + later)
        assert named.used == SECOND
    named.send(2)
    assert listener.recv(1000) == frame(2)
    assert (len(named.recorder.open), named.recorder.closed) == (1, [])


async def test_silent_addresses_are_used_in_turn_until_the_client_answers(named: Named) -> None:
    """Its answer fixes the address from which it comes, whichever is used then. After a silence they change again."""
    clients = {host: named.listen(host) for host in (FIRST, SECOND)}
    for later, host in enumerate((SECOND, FIRST, SECOND), 1):
        named.endpoint.do_housekeeping(monotonic() + later)
        assert named.used == host
    for host in (FIRST, SECOND):
        await named.answer(clients[host])
        assert named.used == host
        named.endpoint.do_housekeeping(monotonic() + REMOTE_SILENT_S - 1.0)
        assert named.used == host
    named.endpoint.do_housekeeping(monotonic() + REMOTE_SILENT_S)
    assert named.used == FIRST
    await asyncio.sleep(0)
    assert len(named.recorder.open) == 1
