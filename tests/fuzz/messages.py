"""Bytes inside TLS to a relay and to a member: HTTP, WebSocket messages, any bytes, cut anywhere."""

from __future__ import annotations

import asyncio
import atexit
import socket
from typing import Final

from websockets.uri import parse_uri
from websockets.utils import accept_key

from tests.fuzz.engine import Run, Script
from tests.io.inside import held_bytes
from tests.tls.web_streams import REQUEST, Owner, frame
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch
from uavlinkd.tls.stream import MAX_MESSAGE, WebStream, client_protocol, server_protocol

LOOP: Final = asyncio.new_event_loop()
"""Of all scripts; it is closed when the process ends."""
atexit.register(LOOP.close)
BINARY: Final = 2
REASONS: Final = {
    *("closed", "fragment", "long_header", "long_message", "not_websocket", "pings", "protocol", "text"),
    "wrong_path",
}
WORDS: Final = (b"GET / HTTP/1.1\r\n", b"HTTP/1.1 404 ", b"\r\n\r\n", b"Upgrade: h2\r\n", b"Content-Length: 9\r\n")
MAX_HELD: Final = 16_384


def _messages(script: Script, *, masked: bool) -> tuple[bytes, list[bytes], bool]:
    """Frames, the datagrams before the first fault, and whether that is noise, in which there may be datagrams."""
    parts: list[bytes] = []
    datagrams: list[bytes] = []
    is_valid, has_noise = True, False
    while script:
        how = script.byte()
        content = script.take(how >> 4) * (1 + (script.byte() if how & 15 == 1 else 0))
        opcode, fin, is_masked = BINARY, True, masked
        match how & 15:
            case 2:
                opcode = 9 + (script.byte() & 1)
            case 3:
                opcode, fin = script.byte() & 15, bool(how & 16)
            case 4:
                is_masked = not masked
            case 5:
                parts.append(content)
                has_noise = has_noise or (is_valid and bool(content))
                is_valid = is_valid and not content
                continue
        is_datagram = opcode == BINARY and fin and len(content) <= MAX_MESSAGE
        is_control = opcode in {9, 10} and fin and len(content) < 126
        is_valid = is_valid and is_masked is masked and (is_datagram or is_control)
        parts.append(frame(opcode, content, fin=fin, masked=is_masked))
        if is_valid and is_datagram:
            datagrams.append(content)
    return b"".join(parts), datagrams, has_noise


class _End:
    """One end of a connection whose other end is the script."""

    def __init__(self, stall: StallWatch, *, is_relay: bool) -> None:
        ours, self.other = socket.socketpair()
        self.owner = Owner()
        protocol = server_protocol() if is_relay else client_protocol(parse_uri("ws://relay.example.org/uavlink"))
        self.stream = WebStream(ours, protocol, None, self.owner, stall, "fuzz")
        self.stream.start()
        self.opening = REQUEST
        if not is_relay:
            key = self.other.recv(4096).partition(b"Sec-WebSocket-Key: ")[2][:24].decode()
            answer = "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            self.opening = f"{answer}Sec-WebSocket-Accept: {accept_key(key)}\r\n\r\n".encode()

    def feed(self, data: bytes, cuts: bytes) -> None:
        """Deliver bytes in chunks, until the stream is lost."""
        at, number, now = 0, 0, monotonic()
        while at < len(data) and not self.stream.lost:
            size = 1 + (cuts[number % len(cuts)] if cuts else 255)
            self.stream.on_bytes(data[at : at + size], now, 0)
            assert held_bytes(self.stream) <= MAX_HELD, "more is held than a header or a message"
            at, number = at + size, number + 1

    def close(self) -> None:
        self.stream.lose("closed")
        self.other.close()
        assert self.owner.reasons == [self.stream.lost], "lost more than once"
        assert all(len(datagram) <= MAX_MESSAGE for datagram in self.owner.datagrams), "longer than a datagram"
        assert self.stream.lost in REASONS or self.stream.lost.startswith("http_"), self.stream.lost


async def _open(data: bytes, stall: StallWatch) -> None:
    """Messages on an open connection: the cuts do not change what is delivered, nor the reason of the end."""
    script, is_relay, cuts = Script(data[9:]), bool(data[0] & 1), data[1:9]
    messages, datagrams, has_noise = _messages(script, masked=is_relay)
    ends = [_End(stall, is_relay=is_relay) for _ in range(2)]
    for end, these in zip(ends, (cuts, b""), strict=True):
        end.feed(end.opening, b"")
        assert end.owner.opened == 1, "it did not open"
        end.feed(messages, these)
        end.close()
    if "pings" not in (ends[0].stream.lost, ends[1].stream.lost):
        assert ends[0].owner.datagrams == ends[1].owner.datagrams, "the cuts change what is received"
        assert ends[0].stream.lost == ends[1].stream.lost, "the cuts change the reason"
        assert ends[0].owner.datagrams[: len(datagrams)] == datagrams, "a datagram is missing"
        assert has_noise or len(ends[0].owner.datagrams) == len(datagrams), "more than the datagrams is delivered"


async def _connecting(data: bytes, stall: StallWatch) -> None:
    """HTTP, altered, or any bytes."""
    end = _End(stall, is_relay=bool(data[0] & 1))
    at, size = int.from_bytes(data[1:3], "big") % (len(end.opening) + 1), data[3]
    end.feed(end.opening[:at] + data[9:] + end.opening[at + size :], data[3:9])
    end.close()


def make() -> Run:
    """No byte raises; each end has a name; what is held is bounded."""

    def run(data: bytes) -> None:
        if len(data) < 10:
            return
        stall = StallWatch(monotonic(), lambda pause_s: None)
        LOOP.run_until_complete((_open if data[0] & 2 else _connecting)(data, stall))

    return run
