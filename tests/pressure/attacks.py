"""The attackers: each is a process of its own, that sends datagrams to one daemon until its standard input ends.

``python -m tests.pressure.attacks NAME`` reads a :class:`Target` as JSON from the first line of its standard input.
"""

from __future__ import annotations

import json
import os
import select
import socket
import sys
from base64 import b64decode
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from time import monotonic
from unittest.mock import patch

from tests.authority.signing import CERTIFICATE, signed
from tests.kernel_queues import memory_of, receive_queue
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import handshake, wire
from uavlinkd.protocol.cookie import MacKeys, mac1_of
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.kem import FfdheGroup
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES_BY_NAME, X25519

HOSTS = tuple(f"127.0.0.{number}" for number in range(2, 6))
STRANGERS_HOSTS = tuple(f"127.2.{number}.9" for number in range(50))
STRANGERS = 200
SPOOFED_SOCKETS = 500
FRAME_BYTES = 8
STARTS_FRAME_BYTES = 266
_TICK_S = 0.002


@dataclass(frozen=True)
class Target:
    """The address of the daemon, the attacker's keys, and its rate."""

    port: int
    public_key: str
    captured_key: str
    psk: str
    per_s: float
    suite: str = "x25519"
    envelope_bytes: int = c.DEFAULT_ENVELOPE_LIMIT
    queue_bytes: int | None = None
    """How much of the daemon's receive buffer the attacker fills. Without a limit the kernel drops datagrams of other
    peers while the daemon waits for a processor."""

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @property
    def address(self) -> tuple[str, int]:
        """The public key of the daemon."""
        return "127.0.0.1", self.port

    def settings(self) -> PeerSettings:
        link = Link(suites=(SUITES_BY_NAME[self.suite],))
        return PeerSettings("victim", b64decode(self.public_key), Secret(b64decode(self.psk)), link)


class _Room:
    """The room that an attacker has in the daemon's receive buffer."""

    def __init__(self) -> None:
        self._left: float = 0

    def take(self, size: int, target: Target) -> bool:
        """Whether a datagram of ``size`` bytes may be sent."""
        if target.queue_bytes is None:
            return True
        memory = memory_of(size)
        if memory > self._left:
            self._left = target.queue_bytes - receive_queue(target.port).waiting_bytes
        if memory > self._left:
            return False
        self._left -= memory
        return True


_room = _Room()


def _ticks(per_s: float) -> Iterator[int]:
    """Yield the number of datagrams that are due, until standard input ends."""
    began, sent = monotonic(), 0
    while not select.select([sys.stdin], [], [], _TICK_S)[0]:
        due = int((monotonic() - began) * per_s) - sent
        sent += due
        if due:
            yield due


def _socket(host: str) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((host, 0))
    sock.setblocking(False)
    return sock


def initiations(target: Target) -> None:
    """Honest initiations of the captured peer, all different, from four hosts that answer with their cookies.

    The daemon cannot tell them from recorded ones that it reads for the first time.
    """
    captured, settings = KeyPair(b64decode(target.captured_key)), target.settings()
    share = FfdheGroup(int(target.suite.removeprefix("ffdhe"))).generate(os.urandom)
    with patch.object(FfdheGroup, "generate", lambda *_: share):  # the attacker does not pay for what it never uses
        _initiate(target, HOSTS, lambda index: handshake.initiate(captured, settings, index, 0, os.urandom).message)


def strangers(target: Target) -> None:
    """Initiations of keys that the daemon does not know, from many hosts that answer with their cookies."""
    _initiate_as_strangers(target, b"")


def certificates(target: Target) -> None:
    """The same, each with a certificate that the authority signed for another key."""
    _initiate_as_strangers(target, signed(CERTIFICATE, os.urandom(c.KEY_BYTES)))


def silence(target: Target) -> None:
    """Nothing, to compare with."""
    for _ in _ticks(target.per_s):
        pass


def _initiate_as_strangers(target: Target, certificate: bytes) -> None:
    settings = target.settings()
    messages = [
        handshake.initiate(KeyPair(os.urandom(c.KEY_BYTES)), settings, 1 + number, 0, os.urandom, certificate).message
        for number in range(STRANGERS)
    ]
    # The daemon remembers only the messages of peers: it reads these again.
    _initiate(target, STRANGERS_HOSTS, lambda index: messages[(index - 1) % STRANGERS])


def _initiate(target: Target, hosts: Sequence[str], message: Callable[[int], bytes]) -> None:
    """Send initiations from hosts that answer with their cookies. ``message``: the next one, by a number."""
    socks = [_socket(host) for host in hosts]
    cookies: dict[socket.socket, bytes] = {}
    macs = MacKeys(b64decode(target.public_key))
    sent: dict[tuple[socket.socket, int], bytes] = {}
    number = 0
    for due in _ticks(target.per_s):
        for _ in range(due):
            number += 1
            sock = socks[number % len(socks)]
            datagram = macs.add_macs(message(1 + number % 65535), cookies.get(sock))
            sent[sock, wire.parse_initiation(datagram).sender_index] = mac1_of(datagram)
            _send(sock, datagram, target)
        for sock in socks:
            for answer in _received(sock):
                with suppress(Drop, KeyError):
                    reply = wire.parse_cookie_reply(answer)
                    cookies[sock] = macs.open_cookie(reply, sent[sock, reply.receiver_index])


def spoofed(target: Target) -> None:
    """Initiations with a valid mac1 from many prefixes, which no cookie reply reaches."""
    socks = [_socket(f"127.{1 + number // 250}.{number % 250}.9") for number in range(SPOOFED_SOCKETS)]
    macs = MacKeys(b64decode(target.public_key))
    size = wire.initiation_bytes(X25519) - wire.MACS_BYTES
    datagrams = []
    for number in range(20_000):
        header = wire.initiation_header(X25519, 1 + number % 65535)
        datagrams.append(macs.add_macs(header + os.urandom(size - len(header)), None))
    number = 0
    for due in _ticks(target.per_s):
        for _ in range(due):
            number += 1
            _send(socks[number % len(socks)], datagrams[number % len(datagrams)], target)


def envelopes(target: Target) -> None:
    """Genuine envelopes of ``envelope_bytes`` bytes, whatever was agreed, filled with the shortest frames."""
    _insider(target, _shortest_frames(target.envelope_bytes), FRAME_BYTES)


def starts(target: Target) -> None:
    """Genuine envelopes of file transfer with start bytes only: the most expensive search for hidden frames."""
    _insider(target, _frames_of_starts(target.envelope_bytes), STARTS_FRAME_BYTES)


def _insider(target: Target, filling: bytes, frame_bytes: int) -> None:
    sock = _socket("127.0.0.1")
    node = Node(Secret(b64decode(target.captured_key)), os.urandom, monotonic())
    victim = node.add_peer(target.settings(), monotonic())
    node.set_paths(victim, [Path(0, target.address)], monotonic())
    for due in _ticks(target.per_s):
        outputs = node.handle_timeout(monotonic()) if monotonic() >= node.next_deadline() else []
        for answer in _received(sock):
            outputs += node.receive(answer, Path(0, target.address), monotonic())
        for output in outputs:
            if isinstance(output, Transmit):
                _send(sock, output.datagram, target)
        session = victim.sessions.current
        if session is not None:
            for _ in range(due):
                if not _send(sock, _fill(session, filling, frame_bytes, target.envelope_bytes), target):
                    break


def _fill(session: Session, filling: bytes, frame_bytes: int, size: int) -> bytes:
    room = size - session.envelope_bytes(0)
    return session.seal(filling[: room - room % frame_bytes], monotonic())


def _frames_of_starts(size: int) -> bytes:
    """FILE_TRANSFER_PROTOCOL of system 2, one for each sequence number."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    codec = mavlink.MAVLink(None, 2, 1)
    frames = []
    for seq in range(size // STARTS_FRAME_BYTES):
        codec.seq = seq % 256
        frames.append(bytes(mavlink.MAVLink_file_transfer_protocol_message(254, 254, 254, [254] * 251).pack(codec)))
    return b"".join(frames)


def _shortest_frames(size: int) -> bytes:
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    frames = []
    for seq in range(size // FRAME_BYTES):
        head = bytes((0xFE, 0, seq % 256, 2, 1, seq // 256))
        crc = mavlink.x25crc(head[1:])
        crc.accumulate(bytes((50,)))
        frames.append(head + int(crc.crc).to_bytes(2, "little"))
    return b"".join(frames)


def _send(sock: socket.socket, datagram: bytes, target: Target) -> bool:
    """Send a datagram. Returns whether the daemon's receive buffer had room for it."""
    if not _room.take(len(datagram), target):
        return False
    with suppress(OSError):  # no room in the attacker's own buffer: as if the network had lost it
        sock.sendto(datagram, target.address)
    return True


def _received(sock: socket.socket) -> Iterator[bytes]:
    with suppress(OSError):
        while True:
            yield sock.recv(65536)


ATTACKS = {
    item.__name__: item for item in (initiations, strangers, certificates, silence, spoofed, envelopes, starts)
}

if __name__ == "__main__":
    ATTACKS[sys.argv[1]](Target(**json.loads(sys.stdin.readline())))
