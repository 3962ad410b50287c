"""mac1, mac2 and cookies: what must be right before a handshake message costs a key exchange.

WireGuard's design (whitepaper, section 5.4.7) with HMAC-SHA256, and without XChaCha20, which OpenSSL lacks:
the cookie is sealed with ChaCha20-Poly1305 under a key made of the responder's public key and a fresh nonce.
"""

from __future__ import annotations

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.crypto import AeadKey, Entropy, equal, hmac_sha256, sha256
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.path import Path

_NO_COOKIE = bytes(c.MAC_BYTES)


def mac1_key(public_key: bytes, protocol_name: bytes) -> bytes:
    """The key of mac1 in messages to the holder of ``public_key``, in one version of the protocol."""
    return sha256(protocol_name + b" mac1" + public_key)


def fits_mac1(key: bytes, datagram: bytes) -> bool:
    """Whether the mac1 of a handshake message was made with this key."""
    covered = datagram[: -wire.MACS_BYTES]
    return equal(hmac_sha256(key, covered)[: c.MAC_BYTES], mac1_of(datagram))


class MacKeys:
    """The keys that follow from one static public key: anyone who knows it can make mac1 and open cookies."""

    __slots__ = ("_cookie", "_mac1")

    def __init__(self, public_key: bytes) -> None:
        self._mac1 = mac1_key(public_key, c.PROTOCOL_NAME)
        self._cookie = sha256(c.PROTOCOL_NAME + b" cookie" + public_key)

    def add_macs(self, message: bytes, cookie: bytes | None) -> bytes:
        """The message with mac1 and mac2 behind it; mac2 is zero without a cookie."""
        message += hmac_sha256(self._mac1, message)[: c.MAC_BYTES]
        if cookie is None:
            return message + _NO_COOKIE
        return message + hmac_sha256(cookie, message)[: c.MAC_BYTES]

    def has_valid_mac1(self, datagram: bytes) -> bool:
        """Whether the sender knew our public key, and nothing was altered since."""
        return fits_mac1(self._mac1, datagram)

    def seal_cookie(self, cookie: bytes, nonce: bytes, mac1: bytes) -> bytes:
        """The cookie for the sender of the message that carried ``mac1``."""
        return AeadKey(hmac_sha256(self._cookie, nonce)).seal(0, cookie, mac1)

    def open_cookie(self, reply: wire.CookieReply, mac1: bytes) -> bytes:
        """The cookie in a reply to our message that carried ``mac1``. Raises ``BAD_COOKIE``."""
        cookie = AeadKey(hmac_sha256(self._cookie, reply.nonce)).open(0, reply.sealed, mac1)
        if cookie is None:
            raise Drop(DropReason.BAD_COOKIE)
        return cookie


def mac1_of(datagram: bytes) -> bytes:
    """The mac1 that a handshake message carries."""
    return datagram[-wire.MACS_BYTES : -c.MAC_BYTES]


class CookieJar:
    """Cookies for senders: an HMAC of the source address, so the daemon remembers nothing about a sender."""

    def __init__(self, keys: MacKeys, entropy: Entropy, now: float) -> None:
        self.keys = keys
        self._entropy = entropy
        self._secret = self._previous = entropy(c.KEY_BYTES)
        self._changed_at = now

    def has_valid_mac2(self, datagram: bytes, path: Path, now: float) -> bool:
        """Whether mac2 was made with a cookie that this daemon sent to this source, at most four minutes ago."""
        covered, mac2 = datagram[: -c.MAC_BYTES], datagram[-c.MAC_BYTES :]
        if mac2 == _NO_COOKIE:
            return False
        self._change_secret(now)
        # Always compute both, so that the time does not show which secret fits.
        fits = [
            equal(hmac_sha256(_cookie(secret, path), covered)[: c.MAC_BYTES], mac2)
            for secret in (self._secret, self._previous)
        ]
        return any(fits)

    def reply(self, datagram: bytes, sender_index: int, path: Path, now: float) -> bytes:
        """A cookie reply to the handshake message in ``datagram``; shorter than any of them."""
        self._change_secret(now)
        nonce = self._entropy(c.COOKIE_NONCE_BYTES)
        sealed = self.keys.seal_cookie(_cookie(self._secret, path), nonce, mac1_of(datagram))
        return wire.encode_cookie_reply(sender_index, nonce, sealed)

    def _change_secret(self, now: float) -> None:
        age = now - self._changed_at
        if age < c.COOKIE_SECRET_LIFETIME_S:
            return
        fresh = self._entropy(c.KEY_BYTES)
        # After a long silence the secret before this one is too old as well.
        self._previous = self._secret if age < 2 * c.COOKIE_SECRET_LIFETIME_S else fresh
        # The time when it was due, not now: an unused secret would be valid for longer.
        self._secret, self._changed_at = fresh, now - age % c.COOKIE_SECRET_LIFETIME_S


def _cookie(secret: bytes, path: Path) -> bytes:
    return hmac_sha256(secret, " ".join(map(str, path.place)).encode())[: c.MAC_BYTES]


OTHERS = tuple(version for version in range(1, c.LAST_KNOWN_VERSION + 1) if version != c.PROTOCOL_VERSION)
"""The versions that are compared."""


def version_of(initiation: bytes, public_key: bytes) -> int | None:
    """The other version in which an initiation is for the holder of this key.

    None for any other message: its sender does not know the key, or it was altered. A match proves that its sender
    knows the public key, and no more.
    """
    if not wire.MACS_BYTES < len(initiation) <= c.VERSION_CHECK_BYTES:
        return None
    macs = ((version, mac1_key(public_key, b"uavlink/%d" % version)) for version in OTHERS)
    return next((version for version, key in macs if fits_mac1(key, initiation)), None)
