"""The bytes of one TCP connection, inside TLS or plain, without a buffer in which old data could wait.

The kernel holds at most one unsent segment, and a TLS record is made only when the kernel has room for it. asyncio's
and uvloop's TLS keep queues of their own, so this uses neither.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
import sys
from array import array
from collections.abc import Callable
from typing import Final, Protocol

from uavlinkd.io.ports import failure_name
from uavlinkd.io.sockets import set_options
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import Backlog, StallWatch

if sys.platform == "linux":
    from fcntl import ioctl

TlsFactory = Callable[[ssl.MemoryBIO, ssl.MemoryBIO], ssl.SSLObject]
"""Makes the TLS state of one connection, from the bytes that arrive and those to send."""

UNSENT_BYTES: Final = 1400  # the kernel gets a record while it holds fewer unsent bytes than this
READ_BYTES: Final = 16_384
MAX_REST_BYTES: Final = 32_768  # so many bytes of TLS's own messages may wait for an end that does not read

_SIOCOUTQNSD: Final = 0x894B  # unsent bytes: linux/sockios.h
# The kernel reports a socket as writable when its unsent bytes are below half of TCP_NOTSENT_LOWAT.
_OPTIONS: Final[tuple[tuple[int, str, int | bytes], ...]] = (
    (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
    (socket.IPPROTO_TCP, "TCP_NOTSENT_LOWAT", 2 * UNSENT_BYTES),
    (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", 10_000),
    (socket.IPPROTO_TCP, "TCP_CONGESTION", b"bbr"),
    # The kernel notices an end that is gone without a word.
    (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
    (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 30),
    (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 10),
    (socket.IPPROTO_TCP, "TCP_KEEPCNT", 3),
)


class ChannelOwner(Protocol):
    """What a channel reports to its owner, from the loop's callbacks only."""

    def on_secure(self) -> None:
        """TLS's handshake is complete."""

    def on_bytes(self, data: bytes, now: float, epoch: int) -> None:
        """The bytes of one read, with its monotonic time and epoch."""

    def on_end(self) -> None:
        """The other end sends no more."""

    def on_room(self) -> None:
        """:meth:`TlsChannel.has_room` returned False, and there is room again."""

    def lose(self, reason: str) -> None:
        """The connection failed. The owner closes the channel."""


def server_context(certificate: str, key: str) -> ssl.SSLContext:
    """TLS of a relay, from two PEM files. Raises OSError (ssl.SSLError is one) if they cannot be used."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    _limit(context)
    context.load_cert_chain(certificate, key, password=lambda: "")  # otherwise OpenSSL asks on the terminal
    context.num_tickets = 0  # a session is not resumed: tickets would cost memory and bytes
    return context


def server_tls(context: ssl.SSLContext) -> TlsFactory:
    return lambda incoming, outgoing: context.wrap_bio(incoming, outgoing, server_side=True)


def client_tls(host: str) -> TlsFactory:
    """TLS of a member. The certificate is not verified: the members' keys are, inside. ``host`` is for SNI."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    _limit(context)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return lambda incoming, outgoing: context.wrap_bio(incoming, outgoing, server_hostname=host)


def _limit(context: ssl.SSLContext) -> None:
    context.minimum_version = ssl.TLSVersion.TLSv1_2  # some firewalls that inspect TLS have no newer one
    context.options |= ssl.OP_NO_RENEGOTIATION


class TlsChannel:
    """One connection. ``tls`` is None for a plain one. ``opened_in``: as of a :class:`Backlog`."""

    def __init__(
        self,
        sock: socket.socket,
        tls: TlsFactory | None,
        owner: ChannelOwner,
        stall: StallWatch,
        opened_in: int | None = None,
    ) -> None:
        self.bytes_sent = 0  # those that the kernel accepted, with TLS's own
        self.is_open = True
        self.is_secure = False  # whether TLS's handshake is complete, or there is none
        self._sock = sock
        self._fd = sock.fileno()
        self._owner = owner
        self._loop = asyncio.get_running_loop()
        self._rest = b""  # at most one record, or messages of a handshake, that the kernel has not accepted
        self._is_watching = False  # the kernel reports when it has room
        self._unsent = array("i", [0])
        sock.setblocking(False)
        set_options(sock, _OPTIONS)
        self._backlog = Backlog(stall, self._fd, self._capacity, opened_in)
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = tls(self._in, self._out) if tls is not None else None

    def start(self) -> None:
        self._loop.add_reader(self._fd, self._on_readable)
        if self._tls is None:
            self.is_secure = True
            self._owner.on_secure()
        elif not self._tls.server_side:
            self._shake_hands(self._tls)

    def close(self) -> None:
        if self.is_open:
            self.is_open = False
            self._loop.remove_reader(self._fd)
            if self._is_watching:
                self._loop.remove_writer(self._fd)
            self._sock.close()
            self._backlog.close()
            self._rest = b""
            self._tls = None  # otherwise its memory would wait for the collector of circles

    # Sending.

    def has_room(self) -> bool:
        """Whether the kernel takes a record now. If not, the channel calls ``on_room`` when it does."""
        if not self.is_open:
            return False
        if not self._rest:
            if sys.platform == "linux":
                ioctl(self._fd, _SIOCOUTQNSD, self._unsent)
            if self._unsent[0] < UNSENT_BYTES:
                return True
        self._watch()
        return False

    def write(self, data: bytes) -> None:
        """Pass bytes to the kernel, in a record. Call it while there is room; in a handshake, at any time."""
        if not self.is_open:
            return
        if self._tls is None:
            self._rest += data
        elif data:
            try:
                self._tls.write(data)
            except ssl.SSLError:  # the other end began a handshake again, and did not end it
                self._fail()
                return
        self._pass_on()

    def _pass_on(self) -> None:
        """Pass what waits to the kernel, with TLS's own messages."""
        self._rest += self._out.read()
        if not self._rest:
            return
        try:
            count = self._sock.send(self._rest)
        except BlockingIOError:
            count = 0
        except OSError as error:
            self._owner.lose(failure_name(error))
            return
        self.bytes_sent += count
        self._rest = self._rest[count:]
        if len(self._rest) > MAX_REST_BYTES:
            self._owner.lose("not_reading")
        elif self._rest:
            self._watch()

    def _watch(self) -> None:
        if not self._is_watching:
            self._is_watching = True
            self._loop.add_writer(self._fd, self._on_writable)

    def _on_writable(self) -> None:
        self._pass_on()
        if self.is_open and not self._rest:
            self._is_watching = False
            self._loop.remove_writer(self._fd)
            self._owner.on_room()

    # Receiving.

    def _on_readable(self) -> None:
        now = monotonic()
        epoch = self._backlog.begin(now)
        try:
            data = self._sock.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self._owner.lose(failure_name(error))
            return
        self._backlog.end(len(data), is_empty=len(data) < READ_BYTES)
        has_ended = not data
        if self._tls is not None and data:
            data, has_ended = self._decrypt(self._tls, data)
        if data and self.is_open:
            self._owner.on_bytes(data, now, epoch)
        if has_ended and self.is_open:
            self._owner.on_end()

    def _decrypt(self, tls: ssl.SSLObject, data: bytes) -> tuple[bytes, bool]:
        """The bytes inside, and whether the stream has ended."""
        self._in.write(data)
        parts: list[bytes] = []
        has_ended = False
        try:
            if self.is_secure or self._shake_hands(tls):
                while part := tls.read(READ_BYTES):
                    parts.append(part)
                has_ended = True
        except ssl.SSLWantReadError:
            pass
        except ssl.SSLZeroReturnError:
            has_ended = True
        except ssl.SSLError:
            self._fail()
        if self._out.pending and self.is_open:
            self._pass_on()
        return b"".join(parts), has_ended

    def _shake_hands(self, tls: ssl.SSLObject) -> bool:
        """Go on with TLS's handshake. Returns whether it is complete."""
        try:
            tls.do_handshake()
        except ssl.SSLWantReadError:
            self._pass_on()
        except ssl.SSLError:
            self._fail()
        else:
            self.is_secure = True
            self._pass_on()
            if self.is_open:
                self._owner.on_secure()
        return self.is_secure and self.is_open

    def _fail(self) -> None:
        """TLS failed: send its alert."""
        self._pass_on()
        if self.is_open:
            self._owner.lose("tls")

    def _capacity(self) -> int:
        return self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
