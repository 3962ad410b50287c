"""The handshake of WireGuard, both roles: Noise IKpsk2 with BLAKE2s. Whitepaper, sections 5.4.1 to 5.4.7.

Letters are those of the whitepaper: C is the chaining key, H the hash of the transcript, E an ephemeral key, S a
static one. There is no PSK: a station is set up by a code that a person scans, and a new one is made in seconds.

::

    initiation   01 000000 | sender 4 | E 32 | sealed S 48 | sealed timestamp 28 | mac1 16 | mac2 16       148 bytes
    response     02 000000 | sender 4 | receiver 4 | E 32 | sealed nothing 16 | mac1 16 | mac2 16           92 bytes
    cookie       03 000000 | receiver 4 | nonce 24 | sealed cookie 32                                       64 bytes
"""

from __future__ import annotations

from struct import Struct
from typing import Final, NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import AeadKey, Entropy, KeyPair, equal
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.path import Path
from uavlinkd.stations.primitives import MAC_BYTES, XNONCE_BYTES, blake2, hkdf, mac, xchacha

INITIATION: Final = b"\1\0\0\0"
RESPONSE: Final = b"\2\0\0\0"
COOKIE_REPLY: Final = b"\3\0\0\0"
INITIATION_BYTES: Final = 148
RESPONSE_BYTES: Final = 92
COOKIE_REPLY_BYTES: Final = 64
TIMESTAMP_BYTES: Final = 12
_INDEX: Final = Struct("<I")
_NO_PSK: Final = bytes(32)
_NO_MAC: Final = bytes(MAC_BYTES)
_C: Final = blake2(b"Noise_IKpsk2_25519_ChaChaPoly_BLAKE2s")
_H: Final = blake2(_C + b"WireGuard v1 zx2c4 Jason@zx2c4.com")


class TunnelKeys(NamedTuple):
    """The keys of a session, and the number that the other end gave to it."""

    send: AeadKey
    receive: AeadKey
    remote_index: int


class Macs:
    """The keys that follow from one static public key: anyone who knows it can make mac1 and open cookies."""

    def __init__(self, public: bytes) -> None:
        self._mac1 = blake2(b"mac1----" + public)
        self._cookie = blake2(b"cookie--" + public)

    def add(self, message: bytes, cookie: bytes | None) -> bytes:
        """The message with mac1 and mac2 behind it; mac2 is zero without a cookie."""
        message += mac(self._mac1, message)
        return message + (_NO_MAC if cookie is None else mac(cookie, message))

    def has_valid_mac1(self, datagram: bytes) -> bool:
        """Whether the sender knew the public key, and nothing was altered since."""
        return equal(mac(self._mac1, datagram[: -2 * MAC_BYTES]), mac1_of(datagram))

    def seal(self, cookie: bytes, nonce: bytes, mac1: bytes) -> bytes:
        """The cookie for the sender of the message that carried ``mac1``."""
        key, counter = xchacha(self._cookie, nonce)
        return key.seal(counter, cookie, mac1)

    def open(self, reply: bytes, mac1: bytes) -> bytes:
        """The cookie in a reply to a message that carried ``mac1``. Raises ``BAD_COOKIE``."""
        key, counter = xchacha(self._cookie, reply[8 : 8 + XNONCE_BYTES])
        cookie = key.open(counter, reply[8 + XNONCE_BYTES :], mac1)
        if cookie is None:
            raise Drop(DropReason.BAD_COOKIE)
        return cookie


def mac1_of(datagram: bytes) -> bytes:
    """The mac1 that a handshake message carries."""
    return datagram[-2 * MAC_BYTES : -MAC_BYTES]


class StationCookies:
    """The cookies of this daemon for senders: a MAC of the source address, under a secret of two minutes."""

    def __init__(self, macs: Macs, entropy: Entropy, now: float) -> None:
        self._macs = macs
        self._entropy = entropy
        self._secret = entropy(c.KEY_BYTES)
        self._changed_at = now

    def has_valid_mac2(self, datagram: bytes, path: Path, now: float) -> bool:
        """Whether mac2 was made with a cookie that this daemon sent to this source recently."""
        mac2 = datagram[-MAC_BYTES:]
        return mac2 != _NO_MAC and equal(mac(self._cookie(path, now), datagram[:-MAC_BYTES]), mac2)

    def reply(self, datagram: bytes, sender_index: int, path: Path, now: float) -> bytes:
        """A cookie reply to a handshake message."""
        nonce = self._entropy(XNONCE_BYTES)
        sealed = self._macs.seal(self._cookie(path, now), nonce, mac1_of(datagram))
        return COOKIE_REPLY + _INDEX.pack(sender_index) + nonce + sealed

    def _cookie(self, path: Path, now: float) -> bytes:
        if now - self._changed_at >= c.COOKIE_SECRET_LIFETIME_S:
            self._secret, self._changed_at = self._entropy(c.KEY_BYTES), now
        return mac(self._secret, " ".join(map(str, path.place)).encode())


class StationKey:
    """The static key of the stations' side of a daemon, which is not its key for other daemons."""

    def __init__(self, private: bytes) -> None:
        self.key = KeyPair(private)
        self.macs = Macs(self.key.public)
        self.hash = blake2(_H + self.key.public)


class StationInitiation(NamedTuple):
    """An authentic initiation: the station's static key and timestamp, and what the response continues."""

    static: bytes
    timestamp: bytes
    sender_index: int
    ephemeral: bytes
    ck: bytes
    h: bytes


def read_initiation(own: StationKey, datagram: bytes) -> StationInitiation:
    """Open an initiation with a valid mac1. Raises ``BAD_HANDSHAKE`` or ``INVALID_KEY_SHARE``."""
    (sender,), ephemeral = _INDEX.unpack_from(datagram, 4), datagram[8:40]
    h = blake2(own.hash + ephemeral)
    (ck,) = hkdf(_C, ephemeral, 1)
    ck, k = hkdf(ck, own.key.exchange(ephemeral), 2)
    static = _open(k, datagram[40:88], h)
    h = blake2(h + datagram[40:88])
    ck, k = hkdf(ck, own.key.exchange(static), 2)
    timestamp = _open(k, datagram[88:116], h)
    return StationInitiation(static, timestamp, sender, ephemeral, ck, blake2(h + datagram[88:116]))


def respond(initiation: StationInitiation, ephemeral: KeyPair, index: int) -> tuple[bytes, TunnelKeys]:
    """The response to an initiation, and the keys of the session."""
    ck, h, remote = initiation.ck, initiation.h, Macs(initiation.static)
    (ck,) = hkdf(ck, ephemeral.public, 1)
    h = blake2(h + ephemeral.public)
    (ck,) = hkdf(ck, ephemeral.exchange(initiation.ephemeral), 1)
    (ck,) = hkdf(ck, ephemeral.exchange(initiation.static), 1)
    ck, tau, k = hkdf(ck, _NO_PSK, 3)
    sealed = AeadKey(k).seal(0, b"", blake2(h + tau))
    head = RESPONSE + _INDEX.pack(index) + _INDEX.pack(initiation.sender_index)
    receive, send = hkdf(ck, b"", 2)
    keys = TunnelKeys(AeadKey(send), AeadKey(receive), initiation.sender_index)
    return remote.add(head + ephemeral.public + sealed, None), keys


class Initiating(NamedTuple):
    """An initiation of this daemon that waits for its response."""

    datagram: bytes
    number: int
    ephemeral: KeyPair
    ck: bytes
    h: bytes


def initiate(
    own: StationKey, remote: bytes, timestamp: bytes, ephemeral: KeyPair, index: int, cookie: bytes | None
) -> Initiating:
    """An initiation to the station with this static key. Raises ``INVALID_KEY_SHARE``."""
    h = blake2(blake2(_H + remote) + ephemeral.public)
    (ck,) = hkdf(_C, ephemeral.public, 1)
    ck, k = hkdf(ck, ephemeral.exchange(remote), 2)
    static = AeadKey(k).seal(0, own.key.public, h)
    h = blake2(h + static)
    ck, k = hkdf(ck, own.key.exchange(remote), 2)
    stamp = AeadKey(k).seal(0, timestamp, h)
    message = INITIATION + _INDEX.pack(index) + ephemeral.public + static + stamp
    return Initiating(Macs(remote).add(message, cookie), index, ephemeral, ck, blake2(h + stamp))


def read_response(own: StationKey, pending: Initiating, datagram: bytes) -> TunnelKeys:
    """The keys of the session after a response to ``pending``. Raises ``BAD_HANDSHAKE`` or ``INVALID_KEY_SHARE``."""
    (sender,), remote = _INDEX.unpack_from(datagram, 4), datagram[12:44]
    h = blake2(pending.h + remote)
    (ck,) = hkdf(pending.ck, remote, 1)
    (ck,) = hkdf(ck, pending.ephemeral.exchange(remote), 1)
    (ck,) = hkdf(ck, own.key.exchange(remote), 1)
    ck, tau, k = hkdf(ck, _NO_PSK, 3)
    _open(k, datagram[44:60], blake2(h + tau))
    send, receive = hkdf(ck, b"", 2)
    return TunnelKeys(AeadKey(send), AeadKey(receive), sender)


def _open(key: bytes, sealed: bytes, associated: bytes) -> bytes:
    opened = AeadKey(key).open(0, sealed, associated)
    if opened is None:
        raise Drop(DropReason.BAD_HANDSHAKE)
    return opened
