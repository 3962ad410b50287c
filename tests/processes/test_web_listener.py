"""A real relay that listens for TLS: a member with nothing but a WebSocket connects to it, and strangers do."""

from __future__ import annotations

import asyncio
import os
import ssl
from base64 import b64decode
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.tls import listen_for_tls
from tests.waiting import Stopwatch
from uavlinkd.config import keys
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output, PeerClosed, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import X25519
from uavlinkd.protocol.wire import response_bytes
from uavlinkd.system.clock import monotonic
from uavlinkd.tls.listener import STRANGER_S

_AT = Path(0, ("192.0.2.1", 443))


class RawMember:
    """A member of the core, whose datagrams are messages of a WebSocket in the test's hand."""

    def __init__(self, relay: DaemonProcess) -> None:
        private = keys.generate_private_key()
        self.public_key = keys.public_key_text(private)
        self.received: list[bytes] = []
        self.is_closed = False
        """Whether the relay ended the session."""
        self._node = Node(Secret(b64decode(private)), os.urandom, monotonic())
        settings = PeerSettings(
            "relay", b64decode(relay.public_key), None, Link((X25519,), features=c.FEATURE_RECORDS)
        )
        self.peer = self._node.add_peer(settings, monotonic())

    @asynccontextmanager
    async def over(self, socket: ClientConnection) -> AsyncIterator[None]:
        """Talk to the relay meanwhile."""
        self._node.set_paths(self.peer, [_AT], monotonic())
        talking = [asyncio.create_task(self._listen(socket)), asyncio.create_task(self._tick(socket))]
        try:
            yield
        finally:
            for task in talking:
                task.cancel()
            await asyncio.gather(*talking, return_exceptions=True)

    async def _listen(self, socket: ClientConnection) -> None:
        async for message in socket:
            assert isinstance(message, bytes)
            self.received.append(message)
            outputs = self._node.receive(message, _AT, monotonic())
            self.is_closed |= any(isinstance(output, PeerClosed) for output in outputs)
            await _send(socket, outputs)

    async def _tick(self, socket: ClientConnection) -> None:
        while True:
            await _send(socket, self._node.handle_timeout(monotonic()))
            await asyncio.sleep(0.02)


async def _send(socket: ClientConnection, outputs: list[Output]) -> None:
    for output in outputs:
        if isinstance(output, Transmit):
            await socket.send(output.datagram)


def unverified() -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


def _websocket(port: int) -> connect:
    return connect(f"wss://127.0.0.1:{port}/uavlink", ssl=unverified(), compression=None)


def _relay(stage: Stage) -> tuple[DaemonProcess, RawMember, int]:
    """A relay with one member, and its port."""
    relay, port = stage.daemon("relay"), free_port()
    member = RawMember(relay)
    relay.config["member"] = [{"name": "drone1", "public_key": member.public_key}]
    listen_for_tls(relay, port=port)
    return relay, member, port


def _https(status: Mapping[str, Any]) -> dict[str, Any]:
    https: dict[str, Any] = status["relay"]["https"]
    return https


async def _ask(port: int, request: str) -> bytes:
    """The whole answer of the relay to a request of HTTP by TLS."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=unverified())
    writer.write(f"{request}\r\nHost: relay\r\n\r\n".encode())
    answer = b""
    with suppress(OSError):
        answer = await reader.read()
    writer.close()
    return answer


async def test_member_talks_in_messages_of_a_websocket(stage: Stage) -> None:
    """The first message is an initiation, the first answer its response. The connection stays while it is proved."""
    relay, member, port = _relay(stage)
    await stage.start(relay)
    async with _websocket(port) as socket, member.over(socket):
        status = await relay.until(lambda status: bool(status["relay"]["members"]["drone1"]["addresses"]))
        assert socket.local_address is not None
        assert status["relay"]["members"]["drone1"]["addresses"] == [f"127.0.0.1:{socket.local_address[1]}"]
        assert len(member.received[0]) == response_bytes(X25519)
        await relay.until(lambda status: _https(status)["strangers"] == 0)
        await asyncio.sleep(STRANGER_S + 2)
        assert member.peer.is_up
        status = await relay.status()
        assert (_https(status)["connections"], _https(status)["strangers"]) == (1, 0)
    status = await relay.until(lambda status: _https(status)["connections"] == 0)
    assert _https(status)["lost"] == {"closed": 1}
    assert _https(status)["refused"] == {}
    assert relay.events("sends_failed") == []


async def test_strangers_get_nothing(stage: Stage) -> None:
    """Without messages of a member, a connection ends after 5 s."""
    relay, _, port = _relay(stage)
    await stage.start(relay)
    assert (await _ask(port, "GET /admin HTTP/1.1")).startswith(b"HTTP/1.1 404 Not Found\r\n")
    watch = Stopwatch()
    async with _websocket(port) as socket:
        await socket.send(b"\x01 not an initiation")
        await socket.wait_closed()
    assert watch.calm_s < STRANGER_S + 2
    status = await relay.status()
    assert _https(status)["refused"] == {"wrong_path": 1, "unproven": 1}
    assert _https(status)["connections"] == 0
