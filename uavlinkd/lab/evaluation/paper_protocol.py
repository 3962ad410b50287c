"""The paper's protocol between two ends over UDP. It is insecure and only for comparison.

As the paper describes it, each end generates a Diffie-Hellman key pair and sends its public key over UDP. An HMAC key
is derived from the shared secret. Data is sent with its HMAC, which the receiver computes again and compares. There
are no identities, no counters, and one key for both directions.

::

    1 | public key 256                          from the initiator
    2 | public key 256                          the answer
    0x40 or 0x41 | 1 u16 | number u16/u32 | frame | HMAC-SHA256 over all before it 32

The header of a datagram with data is that of our envelopes, so that the same attacks work against both. The HMAC
covers it, but its number is not checked.

The keys change every :data:`RENEW_S`, so that attacks on the exchange have a target, or on request only. The receiver
also accepts the key before the newest, so that an exchange loses no frame.
"""

from __future__ import annotations

import asyncio
import hmac
import socket
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial

from uavlinkd.lab.evaluation.paper import GroupKey, Parameters, load_parameters, mac_key
from uavlinkd.lab.mitm.proxy import received
from uavlinkd.protocol import wire
from uavlinkd.protocol.crypto import hmac_sha256
from uavlinkd.protocol.kem import ffdhe_prime

HELLO, ANSWER = 1, 2
GROUP_BITS = 2048
KEY_BYTES = GROUP_BITS // 8
TAG_BYTES = 32
RENEW_S = 0.25


class PaperKey:
    """A key pair in RFC 7919's ffdhe2048."""

    def __init__(self) -> None:
        with _ffdh():
            self._key = GroupKey(parameters())

    @property
    def public(self) -> bytes:
        return self._key.public.to_bytes(KEY_BYTES, "big")

    def mac_key(self, public: bytes) -> bytes:
        """The HMAC key shared with the owner of ``public``. Raises ValueError if the library refuses the key."""
        with _ffdh():
            return mac_key(self._key.secret(int.from_bytes(public, "big")))


@contextmanager
def _ffdh() -> Iterator[None]:
    """Ignore that cryptography 50 deprecates FFDH; pyproject.toml bounds the version."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Diffie-Hellman over finite fields")
        yield


@cache
def parameters() -> Parameters:
    return load_parameters(ffdhe_prime(GROUP_BITS))


def seal(key: bytes, number: int, frame: bytes) -> bytes:
    signed = wire.envelope_header(1, number) + frame
    return signed + hmac_sha256(key, signed)


def unseal(key: bytes, datagram: bytes) -> bytes | None:
    """The frame in a datagram with data; None if the HMAC is invalid."""
    signed, tag = datagram[:-TAG_BYTES], datagram[-TAG_BYTES:]
    if not hmac.compare_digest(hmac_sha256(key, signed), tag):
        return None
    return signed[header_bytes(datagram) :]


def header_bytes(datagram: bytes) -> int:
    """The length of the header of a datagram with data."""
    return wire.SHORT_HEADER_BYTES if datagram[0] == wire.SHORT_ENVELOPE else wire.LONG_HEADER_BYTES


def is_key(datagram: bytes) -> bool:
    """Whether a datagram has the form of a message with a public key."""
    return len(datagram) == 1 + KEY_BYTES and datagram[0] in (HELLO, ANSWER)


def is_data(datagram: bytes) -> bool:
    """Whether a datagram has the form of one with data."""
    return len(datagram) > wire.LONG_HEADER_BYTES + TAG_BYTES and datagram[0] in (
        wire.SHORT_ENVELOPE,
        wire.LONG_ENVELOPE,
    )


class PaperEnd:
    """One end, with its own socket in the running event loop.

    Args:
        on_frame: called with each frame that has a valid HMAC.
        renew_s: seconds between two exchanges; None for one exchange, and others by :meth:`renew`.
    """

    def __init__(self, *, is_initiator: bool, on_frame: Callable[[bytes], None], renew_s: float | None) -> None:
        self.counters: Counter[str] = Counter()
        """Refused datagrams by reason: ``hmac_mismatch``, ``bad_public_key``, ``malformed``, ``unexpected_key`` (that
        was not requested)."""
        self.exchanges = 0
        self._is_initiator = is_initiator
        self._on_frame = on_frame
        self._renew_s = renew_s
        self._keys: list[bytes] = []  # of the HMAC, the newest first
        self._waiting: PaperKey | None = None
        self._number = 0
        self._to: tuple[str, int] | None = None
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        self._sock.bind(("127.0.0.1", 0))
        self._loop.add_reader(self._sock, self._on_readable)

    @property
    def port(self) -> int:
        return int(self._sock.getsockname()[1])

    def start(self, to: tuple[str, int]) -> None:
        self._to = to
        if self._is_initiator:
            self.renew()

    def renew(self) -> None:
        self._waiting = PaperKey()
        self._send(bytes((HELLO,)) + self._waiting.public)
        if self._renew_s is not None:
            self._timer = self._loop.call_at(self._loop.time() + self._renew_s, self.renew)

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._loop.remove_reader(self._sock)
        self._sock.close()

    def send(self, frame: bytes) -> None:
        """Send a frame with its HMAC; without a key it is lost."""
        if self._keys:
            self._send(seal(self._keys[0], self._number, frame))
            self._number += 1

    def _send(self, datagram: bytes) -> None:
        assert self._to is not None
        try:
            self._sock.sendto(datagram, self._to)
        except OSError:
            self.counters["send_failed"] += 1

    def _on_readable(self) -> None:
        for datagram, _ in received(self._sock):
            self._receive(datagram)

    def _receive(self, datagram: bytes) -> None:
        if is_data(datagram):
            self._receive_data(datagram)
        elif is_key(datagram):
            self._receive_key(datagram[0], datagram[1:])
        else:
            self.counters["malformed"] += 1

    def _receive_key(self, kind: int, public: bytes) -> None:
        ours = PaperKey() if kind == HELLO else self._waiting
        if ours is None or (kind == HELLO) is self._is_initiator:
            self.counters["unexpected_key"] += 1
            return
        try:
            key = ours.mac_key(public)
        except ValueError:
            self.counters["bad_public_key"] += 1
            return
        if kind == HELLO:
            self._send(bytes((ANSWER,)) + ours.public)
        self._waiting = None
        self._keys = [key, *self._keys[:1]]
        self.exchanges += 1

    def _receive_data(self, datagram: bytes) -> None:
        for key in self._keys:
            frame = unseal(key, datagram)
            if frame is not None:
                self._on_frame(frame)
                return
        self.counters["hmac_mismatch"] += 1


def paper_pair(
    names: Sequence[str], on_frame: Callable[[str, bytes], None], renew_s: float | None = RENEW_S
) -> dict[str, PaperEnd]:
    """Two ends, by name. The first one initiates. ``on_frame`` is called with the receiver and each frame."""
    return {
        name: PaperEnd(is_initiator=name == names[0], on_frame=partial(on_frame, name), renew_s=renew_s)
        for name in names
    }
