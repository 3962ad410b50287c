"""coturn as a process, and its clients (RFC 8656). One end of each pair has an allocation, the other end sends to it.

So a datagram passes coturn once, as it passes uavlinkd's relay once: along a channel from the client, and to the
allocation's address from the other end. With an allocation for each end it would pass coturn twice.
"""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from tests.bench.relay.load import PAYLOAD_BYTES, RELAY_CORE, Generator, host
from tests.bench.relay.volleys import Address, Flow, Hosts, Received
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port

COTURN: Final = "turnserver"
"""Of Debian's package coturn."""
MAGIC: Final = 0x2112A442
CHANNEL: Final = 0x4000
_ALLOCATE, _CHANNEL_BIND, _SUCCESS = 0x0003, 0x0009, 0x0100
_CHANNEL_NUMBER, _XOR_PEER, _XOR_RELAYED, _TRANSPORT = 0x000C, 0x0012, 0x0016, 0x0019
_UDP: Final = 17
_HEADER = struct.Struct(">HHI12s")
_ATTRIBUTE = struct.Struct(">HH")
_RETRY_S: Final = 0.5
_START_S: Final = 60.0


def message(kind: int, transaction: bytes, attributes: dict[int, bytes]) -> bytes:
    """A STUN message (RFC 8489, section 5). All attributes here are multiples of four bytes long."""
    body = b"".join(_ATTRIBUTE.pack(number, len(value)) + value for number, value in attributes.items())
    return _HEADER.pack(kind, len(body), MAGIC, transaction) + body


def xored(address: Address) -> bytes:
    """The value of an XOR-…-ADDRESS attribute for IPv4 (RFC 8489, section 14.2)."""
    number = int.from_bytes(socket.inet_aton(address[0]), "big")
    return struct.pack(">BBHI", 0, 1, address[1] ^ MAGIC >> 16, number ^ MAGIC)


def relayed_address(data: bytes) -> Address | None:
    at = _HEADER.size
    while at + _ATTRIBUTE.size <= len(data):
        number, size = _ATTRIBUTE.unpack_from(data, at)
        at += _ATTRIBUTE.size
        if number == _XOR_RELAYED:
            _, _, port, xored_host = struct.unpack_from(">BBHI", data, at)
            return socket.inet_ntoa((xored_host ^ MAGIC).to_bytes(4, "big")), port ^ MAGIC >> 16
        at += (size + 3) & ~3
    return None


class _Client:
    """A host with an allocation and a channel to the other host."""

    def __init__(self, number: int) -> None:
        self.host, self.other = host(2 * number), host(2 * number + 1)
        self.relayed: Address | None = None
        self.is_bound = False
        self.asked_at = 0.0


class Clients:
    """All clients, and the process of coturn."""

    name = "coturn"
    data_start = CHANNEL >> 8

    def __init__(self, folder: Path, pairs: int) -> None:
        self.hosts = Hosts()
        self.server = ("127.0.0.1", free_port())
        self._clients = {client.host: client for client in map(_Client, range(pairs))}
        options = {
            "listening-ip": self.server[0],
            "relay-ip": self.server[0],
            "listening-port": self.server[1],
            "relay-threads": 1,
            "userdb": folder / "turn.db",
            "pidfile": folder / "turn.pid",
            "log-file": folder / "turn.log",
            "cli-password": secrets.token_hex(),  # without one, loopback is refused
        }
        switches = ("no-auth", "no-cli", "no-tcp", "no-tls", "no-dtls", "allow-loopback-peers", "no-stdout-log")
        command = [COTURN, "-n", *(f"--{name}={value}" for name, value in options.items())]
        self._process = subprocess.Popen(
            end_with_parent(*command, *(f"--{name}" for name in switches)),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.sched_setaffinity(self._process.pid, {RELAY_CORE})

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        self.hosts.close()

    def pid(self) -> int:
        return self._process.pid

    @property
    def are_bound(self) -> bool:
        return all(client.is_bound for client in self._clients.values())

    @property
    def flows(self) -> Sequence[Flow]:
        """Of :class:`Relayed`. A channel's datagram begins with its number and length (RFC 8656, section 12.4)."""
        return list(self._flows())

    def _flows(self) -> Iterator[Flow]:
        start = bytes((self.data_start,))  # what the other end receives begins like a channel's datagram too
        header = struct.pack(">HH", CHANNEL, len(start) + PAYLOAD_BYTES)
        for client in self._clients.values():
            assert client.relayed is not None
            yield Flow(client.host, self.server, header + start)
            yield Flow(client.other, client.relayed, start)

    def take(self, received: Received, now: float) -> None:
        client = self._clients.get(received.host)
        if client is None:
            return
        kind = int.from_bytes(received.data[:2], "big")
        if kind == _ALLOCATE | _SUCCESS:
            client.relayed, client.asked_at = relayed_address(received.data), 0.0
        elif kind == _CHANNEL_BIND | _SUCCESS:
            client.is_bound = True
        self._ask(client, now)

    def do_timers(self, now: float) -> None:
        for client in self._clients.values():
            self._ask(client, now)

    def _ask(self, client: _Client, now: float) -> None:
        if client.is_bound or now < client.asked_at + _RETRY_S:
            return
        client.asked_at = now
        if client.relayed is None:
            attributes = {_TRANSPORT: bytes((_UDP, 0, 0, 0))}
            kind = _ALLOCATE
        else:
            number = CHANNEL.to_bytes(2, "big") + bytes(2)
            attributes = {_CHANNEL_NUMBER: number, _XOR_PEER: xored((client.other, self.hosts.port))}
            kind = _CHANNEL_BIND
        self.hosts.send(client.host, message(kind, os.urandom(12), attributes), self.server)


def is_there() -> bool:
    return shutil.which(COTURN) is not None


@contextmanager
def clients(folder: Path, pairs: int) -> Iterator[tuple[Clients, Generator]]:
    """coturn with this many pairs whose channels are there."""
    all_clients = Clients(folder, pairs)
    generator = Generator(all_clients)
    try:
        generator.until(lambda: all_clients.are_bound, _START_S)
        yield all_clients, generator
    finally:
        all_clients.end()
