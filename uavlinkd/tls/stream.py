"""One TCP connection that carries datagrams: each is a binary WebSocket message, inside TLS or plain.

It is for networks that pass only HTTPS. TLS is transport here, not trust: the datagrams protect themselves.

TCP delivers late instead of dropping. So few bytes wait where they cannot be dropped: :mod:`.tls_channel` keeps the
kernel's queue short, and :mod:`.send_window` limits what is on its way. The owner asks :meth:`WebStream.room` and
keeps its own queues.

Each fault of the other end ends this one connection, with a reason that names it.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections import deque
from typing import Final, Protocol

from websockets.client import ClientProtocol
from websockets.exceptions import HeaderLineTooLong, PayloadTooBig, RequestLineTooLong, TooManyHeaders
from websockets.frames import Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.uri import WebSocketURI

from uavlinkd.io.send_window import SendWindow
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import STALE, StallWatch
from uavlinkd.tls.channel import TlsChannel, TlsFactory

PATH: Final = "/uavlink"  # of the relay's WebSocket
MAX_MESSAGE: Final = 2048  # the longest datagram in a message: more than the longest handshake message
GATHER_BYTES: Final = 1250  # datagrams of one turn of the loop share a record up to this size
QUEUE_S: Final = 0.25  # a datagram that waited for longer is dropped
QUEUE_BYTES: Final = 65_536
OPEN_S: Final = 5.0  # for TLS and HTTP
HEADER_BYTES: Final = 8192  # a longer HTTP request or response is refused
LEAST_MESSAGE: Final = 13  # no datagram is shorter
PIECE_BYTES: Final = 2048  # a read is looked at in pieces, so that a fault ends it before the rest costs time
PINGS: Final = 40  # the other end may send so many Pings, and other frames that carry nothing, at once,
PINGS_S: Final = 20  # so many more each second,
PING_BYTES: Final = 1000  # and one for so many bytes

_MESSAGE_HEADER: Final = 8  # bytes of WebSocket for each datagram
_QUIET: Final = logging.Logger("uavlinkd.web_stream")  # not registered: the library's log would repeat our reasons
_QUIET.disabled = True


class StreamHandler(Protocol):
    """The owner of a stream."""

    def on_open(self) -> None:
        """Datagrams may be sent."""

    def on_datagrams(self, datagrams: list[bytes], now: float, epoch: int) -> None:
        """All datagrams of one read, with its monotonic time and epoch."""

    def on_room(self) -> None:
        """What was sent has left, and more would leave at once."""

    def on_lost(self, reason: str) -> None:
        """The connection ended. Called once."""


def server_protocol() -> ServerProtocol:
    """For a relay."""
    return ServerProtocol(max_size=MAX_MESSAGE, logger=_QUIET)


def client_protocol(uri: WebSocketURI) -> ClientProtocol:
    """For a member. ``uri``: of ``websockets.uri.parse_uri``."""
    return ClientProtocol(uri, max_size=MAX_MESSAGE, logger=_QUIET)


class WebStream:
    """One connection, of a member or a relay.

    Reasons of its end: ``closed`` (by the other end), ``tls``, ``not_websocket``, ``http_404`` (a status of the other
    end), ``wrong_path``, ``long_header``, ``slow_handshake``, ``text``, ``fragment``, ``long_message``,
    ``protocol``, ``pings`` (too many, or too many other frames that carry nothing), ``no_pong``, ``not_reading``, or
    the kernel's error, such as ``ECONNRESET``.
    """

    def __init__(  # noqa: PLR0913  all are of this one connection
        self,
        sock: socket.socket,
        protocol: ClientProtocol | ServerProtocol,
        tls: TlsFactory | None,
        handler: StreamHandler | None,
        stall: StallWatch,
        name: str,
        opened_in: int | None = None,
    ) -> None:
        """``handler``: None at a member until it uses the stream. ``name``: of the sender in ``stall.dropped``.

        ``opened_in``: as of a Backlog.
        """
        self.request: Request | None = None  # which opened it, at a relay
        self.is_open = False  # whether datagrams may be sent
        self.lost = ""  # the reason, once it is lost
        self.opened: asyncio.Future[str] = asyncio.get_running_loop().create_future()  # empty, or why it failed
        self.dropped = 0  # datagrams that waited too long
        self._reported = 0  # of them
        self._protocol = protocol
        self.handler = handler
        self._stall = stall
        self._name = name
        self._loop = asyncio.get_running_loop()
        self._channel = TlsChannel(sock, tls, self, stall, opened_in)
        self._window = SendWindow()
        self._queue: deque[tuple[bytes, float]] = deque()
        self._queued_bytes = 0
        self._pong = b""  # the answer to the newest Ping, as a frame: it answers those before, too
        self._header_bytes = 0
        self._pings_left = float(PINGS)
        self._pinged_at = monotonic()
        self._flushing: asyncio.Handle | None = None
        self._opening: asyncio.Handle | None = None

    def start(self, within_s: float = OPEN_S) -> None:
        """Open it within this time."""
        self._opening = self._loop.call_later(within_s, self.lose, "slow_handshake")
        self._channel.start()

    def lose(self, reason: str) -> None:
        """Close the connection."""
        if self.lost:
            return
        self.is_open = False
        self.lost = reason
        self._channel.close()
        for handle in (self._opening, self._flushing):
            if handle is not None:
                handle.cancel()
        self._queue.clear()
        self._queued_bytes = 0
        if not self.opened.done():
            self.opened.set_result(reason)
        if self.handler is not None:
            self.handler.on_lost(reason)
            self.handler = None

    def finish(self) -> None:
        """Send what waits, as far as there is room, and close the connection."""
        if self.is_open:
            self._flush()
        self.lose("finished")

    # Sending.

    def send(self, datagram: bytes) -> None:
        """Queue a datagram. It leaves at the end of the loop's turn, with others, as far as there is room.

        Raises OSError: ENOTCONN if the stream is not open, EMSGSIZE if the datagram is too long, ENOBUFS if others
        that waited too long were dropped since the last call.
        """
        if not self.is_open:
            raise OSError(errno.ENOTCONN, "the stream is not open")
        if len(datagram) > MAX_MESSAGE:
            raise OSError(errno.EMSGSIZE, "longer than a message of a stream")
        now = monotonic()
        self._queue.append((datagram, now))
        self._queued_bytes += len(datagram) + _MESSAGE_HEADER
        self._drop_old(now)
        self._flush_soon()
        if self.dropped != self._reported:
            self._reported = self.dropped
            raise OSError(errno.ENOBUFS, "older datagrams were dropped")

    def room(self, now: float) -> float:
        """How many bytes leave at once if they are sent now."""
        if not self.is_open:
            return 0.0
        room = GATHER_BYTES - self._queued_bytes
        if room > 0 and self._window.is_open and self._channel.has_room():
            return float(room)
        if self._window.is_stuck(now):
            self._flush_soon()
        return 0.0

    def _drop_old(self, now: float) -> None:
        queue = self._queue
        while queue and (now - queue[0][1] > QUEUE_S or self._queued_bytes > QUEUE_BYTES):
            self._queued_bytes -= len(queue.popleft()[0]) + _MESSAGE_HEADER
            self.dropped += 1

    def _flush_soon(self) -> None:
        if self._flushing is None:
            self._flushing = self._loop.call_soon(self._flush)

    def _flush(self) -> None:
        """Make records of what waits, as far as there is room."""
        self._flushing = None
        now, window, channel = monotonic(), self._window, self._channel
        if window.is_stuck(now):
            self.lose("no_pong")
            return
        self._drop_old(now)
        while (self._pong or (self._queue and window.is_open)) and channel.has_room():
            channel.write(self._gather(now))
        if self.handler is not None and not self._queue and window.is_open and channel.has_room():
            self.handler.on_room()

    def _gather(self, now: float) -> bytes:
        """The content of the next record."""
        protocol, queue = self._protocol, self._queue
        pong, self._pong = self._pong, b""
        size = 0
        while queue and self._window.is_open:
            needed = len(queue[0][0]) + _MESSAGE_HEADER
            if size and size + needed > GATHER_BYTES:
                break
            protocol.send_binary(queue.popleft()[0])
            size += needed
        self._queued_bytes -= size
        content = b"".join(protocol.data_to_send())
        if content and (ping := self._window.note_sent(len(content), now)):
            protocol.send_ping(ping)
            content += b"".join(protocol.data_to_send())
        return pong + content

    def _answer(self) -> None:
        """Send what the library has to say."""
        if answer := b"".join(self._protocol.data_to_send()):
            self._channel.write(answer)

    def on_room(self) -> None:
        if self.is_open:
            self._flush()

    # Receiving.

    def on_secure(self) -> None:
        if isinstance(self._protocol, ClientProtocol):
            self._protocol.send_request(self._protocol.connect())
            self._answer()

    def on_bytes(self, data: bytes, now: float, epoch: int) -> None:
        for start in range(0, len(data), PIECE_BYTES):
            if not self.lost:
                self._on_piece(data[start : start + PIECE_BYTES], now, epoch)

    def _on_piece(self, data: bytes, now: float, epoch: int) -> None:
        protocol = self._protocol
        protocol.receive_data(data)
        datagrams: list[bytes] = []
        pings = pongs = small = 0
        fault = ""
        for event in protocol.events_received():
            if isinstance(event, Request):
                fault = self._accept(event)
            elif isinstance(event, Response):
                fault = "" if protocol.state is not State.CONNECTING else _fault_of_response(event)
            elif event.opcode is Opcode.PING:
                pings += 1
            elif event.opcode is Opcode.PONG:
                pongs += 1
                small += not self._window.note_pong(bytes(event.data), now)
            elif not (fault := _fault_of(event)):
                datagrams.append(bytes(event.data))
                small += len(event.data) < LEAST_MESSAGE
            if fault:
                break
        fault = fault or self._fault_of_protocol() or self._count_small(pings + small, len(data), now)
        if not self.is_open and not fault:
            fault = self._note_opening(len(data), pings + len(datagrams))
        if self.is_open and datagrams:
            self._deliver(datagrams, now, epoch)
        if fault:
            self._answer()
            self.lose(fault)
        elif self.is_open:
            if pings:
                self._pong = protocol.data_to_send()[-1]  # while it is open, the library writes only Pongs
            if pings or pongs:
                self._flush_soon()

    def on_end(self) -> None:
        if not self.is_open and self._channel.is_secure:
            self._protocol.receive_eof()  # completes a response without a length
            for event in self._protocol.events_received():
                if isinstance(event, Response):
                    self.lose(_fault_of_response(event))
        self.lose("closed")

    def _note_opening(self, count: int, early: int) -> str:
        """Bytes arrived before the stream was open. Returns a fault, if any."""
        if self._protocol.state is not State.OPEN:
            self._header_bytes += count
            return "long_header" if self._header_bytes > HEADER_BYTES else ""
        if self.request is not None:
            if early:
                return "protocol"  # messages before our response
            self._answer()
        if self._opening is not None:
            self._opening.cancel()
        if not self.lost:
            self.is_open = True
            self.opened.set_result("")
            if self.handler is not None:
                self.handler.on_open()
        return ""

    def _deliver(self, datagrams: list[bytes], now: float, epoch: int) -> None:
        if epoch == STALE:
            self._stall.dropped[self._name] += len(datagrams)
        elif self.handler is not None:
            self.handler.on_datagrams(datagrams, now, epoch)

    def _accept(self, request: Request) -> str:
        """Prepare the response. Returns a fault, if any."""
        protocol = self._protocol
        assert isinstance(protocol, ServerProtocol), "a member receives no request"
        if fault := self._fault_of_protocol():
            return fault  # of bytes behind the request: the library cannot respond any more
        if request.path != PATH:
            response, fault = protocol.reject(404, "There is no such page.\n"), "wrong_path"
        else:
            response = protocol.accept(request)
            fault = "" if response.status_code == 101 else "not_websocket"
        self.request = request
        protocol.send_response(response)
        return fault

    def _count_small(self, frames: int, count: int, now: float) -> str:
        """Returns a fault if there are too many."""
        allowed = self._pings_left + (now - self._pinged_at) * PINGS_S + count / PING_BYTES
        self._pings_left = min(PINGS, allowed) - frames
        self._pinged_at = now
        return "pings" if self._pings_left < 0 else ""

    def _fault_of_protocol(self) -> str:
        """The fault that the library found."""
        protocol = self._protocol
        if isinstance(protocol.handshake_exc, TooManyHeaders | HeaderLineTooLong | RequestLineTooLong):
            return "long_header"
        if protocol.handshake_exc is not None:
            return "not_websocket"
        if isinstance(protocol.parser_exc, PayloadTooBig):
            return "long_message"
        return "" if protocol.parser_exc is None else "protocol"


def _fault_of_response(response: Response) -> str:
    return "not_websocket" if response.status_code == 101 else f"http_{response.status_code}"


def _fault_of(frame: Frame) -> str:
    """Why a frame is not a datagram, or no text if it is one."""
    if frame.opcode is Opcode.CLOSE:
        return "closed"
    if frame.opcode is Opcode.TEXT:
        return "text"
    return "" if frame.opcode is Opcode.BINARY and frame.fin else "fragment"
