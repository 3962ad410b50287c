"""A second implementation of the handshake and the envelopes, written from ``uavlinkd/protocol/README.md`` alone.

It shares no code with the core: what the two agree on, the document says. It is as short as possible: it has no
timers, no replay window and no set of paths, and the test sets the age of its envelopes. `independent_records` and
`independent_fleet` have the records and certificates. `handshake_vectors` makes whole handshakes with both roles.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import struct
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric.mlkem import (
    MLKEM768PrivateKey,
    MLKEM768PublicKey,
    MLKEM1024PrivateKey,
    MLKEM1024PublicKey,
)
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

VERSION = b"uavlink/2"

Draw = Callable[[int], bytes]
"""So many random bytes."""

X25519, FFDHE2048, FFDHE3072, FFDHE4096, FFDHE6144, FFDHE8192, MLKEM768, MLKEM1024 = 0, 1, 2, 3, 4, 5, 16, 17
# Suite: bits of the group, and the number that RFC 7919, appendix A, adds to make its prime safe.
FFDHE = {
    FFDHE2048: (2048, 560316),
    FFDHE3072: (3072, 2625351),
    FFDHE4096: (4096, 5736041),
    FFDHE6144: (6144, 15705020),
    FFDHE8192: (8192, 10965728),
}
GROUPS = {suite: f"FFDHE{bits}" for suite, (bits, _) in FFDHE.items()} | {
    MLKEM768: "MLKEM768",
    MLKEM1024: "MLKEM1024",
}
CIPHERTEXT_BYTES = {suite: bits // 8 for suite, (bits, _) in FFDHE.items()} | {MLKEM768: 1088, MLKEM1024: 1568}
SHARE_BYTES = CIPHERTEXT_BYTES | {MLKEM768: 1184}


@cache
def ffdhe_prime(suite: int) -> int:
    """RFC 7919, appendix A: 2^b - 2^(b-64) + (floor(2^(b-130) e) + X) 2^64 - 1."""
    bits, addition = FFDHE[suite]
    numerator, denominator, k = 1, 1, 0  # e as one fraction: the sum of 1/k! far beyond b bits
    while denominator.bit_length() < bits + 152:
        k += 1
        numerator, denominator = numerator * k + 1, denominator * k
    middle = ((1 << (bits - 130)) * numerator // denominator) + addition
    return (1 << bits) - (1 << (bits - 64)) + (middle << 64) - 1


def _sha256(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def _hmac(key: bytes, data: bytes) -> bytes:
    return hmac.new(key, data, hashlib.sha256).digest()


def _aead_nonce(n: int) -> bytes:
    return bytes(4) + struct.pack("<Q", n)


def _expand(key: bytes, info: bytes, length: int) -> bytes:
    blocks = [b""]
    while sum(map(len, blocks)) < length:
        blocks.append(_hmac(key, blocks[-1] + info + bytes([len(blocks)])))
    return b"".join(blocks)[:length]


class Noise:
    """Section 6: h, ck, k, n and the operations on them."""

    def __init__(self, name: bytes, prologue: bytes, responder_public: bytes) -> None:
        self.h = self.ck = _sha256(name)
        self.k, self.n = b"", 0
        self.mix_hash(prologue)
        self.mix_hash(responder_public)

    def mix_hash(self, data: bytes) -> None:
        self.h = _sha256(self.h + data)

    def _hkdf(self, data: bytes) -> tuple[bytes, bytes, bytes]:
        t = _hmac(self.ck, data)
        first = _hmac(t, b"\x01")
        second = _hmac(t, first + b"\x02")
        return first, second, _hmac(t, second + b"\x03")

    def mix_key(self, data: bytes) -> None:
        self.ck, self.k, _ = self._hkdf(data)
        self.n = 0

    def mix_key_and_hash(self, data: bytes) -> None:
        self.ck, y, self.k = self._hkdf(data)
        self.mix_hash(y)
        self.n = 0

    def seal(self, plaintext: bytes) -> bytes:
        sealed = ChaCha20Poly1305(self.k).encrypt(_aead_nonce(self.n), plaintext, self.h)
        self.mix_hash(sealed)
        self.n += 1
        return sealed

    def open(self, sealed: bytes) -> bytes:
        plaintext = ChaCha20Poly1305(self.k).decrypt(_aead_nonce(self.n), sealed, self.h)
        self.mix_hash(sealed)
        self.n += 1
        return plaintext

    def split(self) -> tuple[bytes, bytes]:
        return self._hkdf(b"")[:2]


class Parameters(NamedTuple):
    """Section 8."""

    generation: int = 0
    confidential: bool = False
    tag_bytes: int = 16
    largest_envelope: int = 1232
    features: int = 0

    def encode(self) -> bytes:
        generation, confidential, tag_bytes, largest, features = self
        return struct.pack(">IHBBHH", generation, features, int(confidential), tag_bytes, 256, largest)


def _agree(ours: Parameters, encoded: bytes) -> Parameters:
    generation, features, flags, tag_bytes, mac_key_bits, largest = struct.unpack(">IHBBHH", encoded)
    assert mac_key_bits == 256
    confidential = ours.confidential or bool(flags & 1)
    return Parameters(
        max(ours.generation, generation) + 1,
        confidential,
        16 if confidential else max(ours.tag_bytes, tag_bytes),
        min(ours.largest_envelope, largest),
        ours.features & features,
    )


class Session:
    """Section 11, both directions."""

    def __init__(
        self, noise: Noise, agreed: Parameters, index: int, remote_index: int, *, is_initiator: bool = True
    ) -> None:
        self.handshake_hash, self.transport_keys = noise.h, noise.split()
        self.parameters = agreed
        self.index, self.remote_index = index, remote_index
        self.counter = 0
        purpose = b" confidential" if agreed.confidential else b" authenticated"
        first, second = self.transport_keys
        ours = _expand(first, VERSION + purpose + b" initiator to responder" + noise.h, 32)
        theirs = _expand(second, VERSION + purpose + b" responder to initiator" + noise.h, 32)
        self.send_key, self.receive_key = (ours, theirs) if is_initiator else (theirs, ours)
        ours = _expand(first, VERSION + b" records initiator to responder" + noise.h, 32)
        theirs = _expand(second, VERSION + b" records responder to initiator" + noise.h, 32)
        self.record_keys = (ours, theirs) if is_initiator else (theirs, ours)

    def seal(self, payload: bytes, *, long_form: bool = False) -> bytes:
        """The next envelope. ``long_form`` writes the counter long where the protocol wants it short."""
        if self.counter < 2**16 and not long_form:
            header = struct.pack(">BHH", 0x40, self.remote_index, self.counter)
        else:
            header = struct.pack(">BHI", 0x41, self.remote_index, self.counter)
        nonce = _aead_nonce(self.counter)
        self.counter += 1
        if self.parameters.confidential:
            return header + ChaCha20Poly1305(self.send_key).encrypt(nonce, payload, header)
        return header + payload + _hmac(self.send_key, header + payload)[: self.parameters.tag_bytes]

    def seal_record(self, record: bytes) -> bytes:
        """Section 21: the next envelope, with a record."""
        sealed = ChaCha20Poly1305(self.record_keys[0]).encrypt(_aead_nonce(self.counter), record, None)
        return self.seal(b"\x07" + sealed)

    def open_record(self, datagram: bytes) -> bytes:
        """The record in an envelope to us with a small counter."""
        payload, counter = self.open(datagram), int.from_bytes(datagram[3:5], "big")
        assert (datagram[0], payload[0]) == (0x40, 7)
        return ChaCha20Poly1305(self.record_keys[1]).decrypt(_aead_nonce(counter), payload[1:], None)

    def open(self, datagram: bytes) -> bytes:
        """The payload of an envelope to us."""
        size = 5 if datagram[0] == 0x40 else 7
        header, body = datagram[:size], datagram[size:]
        kind, index, counter = struct.unpack(">BHH" if size == 5 else ">BHI", header)
        assert (kind == 0x41) == (counter >= 2**16)
        assert index == self.index
        assert len(datagram) <= self.parameters.largest_envelope
        if self.parameters.confidential:
            return ChaCha20Poly1305(self.receive_key).decrypt(_aead_nonce(counter), body, header)
        payload, tag = body[: -self.parameters.tag_bytes], body[-self.parameters.tag_bytes :]
        assert hmac.compare_digest(tag, _hmac(self.receive_key, header + payload)[: self.parameters.tag_bytes])
        return payload


class Initiator:
    """Sections 6 and 7: one handshake as A."""

    def __init__(
        self,
        static: X25519PrivateKey,
        responder_public: bytes,
        *,
        suite: int = X25519,
        psk: bytes = bytes(32),
        parameters: Parameters | None = None,
        draw: Draw = secrets.token_bytes,
    ) -> None:
        self.static, self.responder_public = static, responder_public
        self.suite, self.psk = suite, psk
        self.parameters = Parameters() if parameters is None else parameters
        self.index = int.from_bytes(draw(2), "big") or 1
        self.noise = _start(suite, responder_public)
        self.ephemeral = X25519PrivateKey.from_private_bytes(draw(32))
        seed = draw(64) if suite in GROUPS else bytes(64)
        self.exponent = int.from_bytes(seed, "big")
        mlkem = MLKEM768PrivateKey if suite == MLKEM768 else MLKEM1024PrivateKey
        self.mlkem = mlkem.from_seed_bytes(seed)
        self.mac1 = b""

    def initiation(self, cookie: bytes | None = None, certificate: bytes = b"") -> bytes:
        """Message 1, in the long form with a certificate. Once for each Initiator."""
        header = struct.pack(">BBH", 1, self.suite, self.index)
        noise, public = self.noise, self.ephemeral.public_key().public_bytes_raw()
        noise.mix_hash(public)
        noise.mix_key(public)
        noise.mix_key(_x25519(self.ephemeral, self.responder_public))
        message = header + public
        if self.suite in GROUPS:
            message += noise.seal(self._share())
        message += noise.seal(self.static.public_key().public_bytes_raw())
        noise.mix_key(_x25519(self.static, self.responder_public))
        message += noise.seal(header[1:] + self.parameters.encode() + certificate)
        self.mac1 = _hmac(_sha256(VERSION + b" mac1" + self.responder_public), message)[:16]
        message += self.mac1
        return message + (bytes(16) if cookie is None else _hmac(cookie, message)[:16])

    def read_cookie(self, reply: bytes) -> bytes:
        """The cookie in the answer to our initiation."""
        kind, zero, index = struct.unpack(">BBH", reply[:4])
        assert (kind, zero, index, len(reply)) == (3, 0, self.index, 52)
        key = _hmac(_sha256(VERSION + b" cookie" + self.responder_public), reply[4:20])
        return ChaCha20Poly1305(key).decrypt(_aead_nonce(0), reply[20:], self.mac1)

    def read_response(self, response: bytes) -> Session:
        """Message 2."""
        kind, suite, remote_index, index = struct.unpack(">BBHH", response[:6])
        assert (kind, suite, index) == (2, self.suite, self.index)
        assert remote_index != 0
        own_public = self.static.public_key().public_bytes_raw()
        assert response[-32:-16] == _hmac(_sha256(VERSION + b" mac1" + own_public), response[:-32])[:16]
        noise, body = self.noise, response[6:-32]
        ephemeral, body = body[:32], body[32:]
        noise.mix_hash(ephemeral)
        noise.mix_key(ephemeral)
        noise.mix_key(_x25519(self.ephemeral, ephemeral))
        if self.suite in GROUPS:
            size = CIPHERTEXT_BYTES[self.suite] + 16
            sealed, body = body[:size], body[size:]
            noise.mix_key(self._decapsulate(noise.open(sealed)))
        noise.mix_key(_x25519(self.static, ephemeral))
        noise.mix_key_and_hash(self.psk)
        payload = noise.open(body)
        assert payload[:5] == response[1:6]
        return Session(noise, _agree(self.parameters, payload[5:]), self.index, remote_index)

    def _share(self) -> bytes:
        if self.suite in FFDHE:
            return _power(self.suite, 2, self.exponent)
        return self.mlkem.public_key().public_bytes_raw()

    def _decapsulate(self, ciphertext: bytes) -> bytes:
        if self.suite in FFDHE:
            return _power(self.suite, int.from_bytes(ciphertext, "big"), self.exponent)
        return self.mlkem.decapsulate(ciphertext)


class Responder:
    """Sections 6 and 7: one handshake as B, which knows its initiator."""

    def __init__(
        self,
        static: X25519PrivateKey,
        initiator_public: bytes,
        *,
        psk: bytes = bytes(32),
        parameters: Parameters | None = None,
        draw: Draw = secrets.token_bytes,
    ) -> None:
        self.static, self.initiator_public, self.psk, self.draw = static, initiator_public, psk, draw
        self.parameters = Parameters() if parameters is None else parameters
        self.encapsulated = (b"", b"")
        """The group's ciphertext and secret."""
        self.certificate = b""
        """What the initiator showed."""

    def answer(self, initiation: bytes) -> tuple[bytes, Session]:
        """Message 2, and the session that it makes."""
        kind, suite, remote_index = struct.unpack(">BBH", initiation[:4])
        own_public = self.static.public_key().public_bytes_raw()
        assert kind == 1
        assert remote_index != 0
        assert initiation[-32:-16] == _hmac(_sha256(VERSION + b" mac1" + own_public), initiation[:-32])[:16]
        noise, body = _start(suite, own_public), initiation[4:-32]
        remote, body = body[:32], body[32:]
        noise.mix_hash(remote)
        noise.mix_key(remote)
        noise.mix_key(_x25519(self.static, remote))
        share = b""
        if suite in GROUPS:
            size = SHARE_BYTES[suite] + 16
            share, body = noise.open(body[:size]), body[size:]
        assert noise.open(body[:48]) == self.initiator_public
        noise.mix_key(_x25519(self.static, self.initiator_public))
        payload = noise.open(body[48:])
        assert payload[:3] == initiation[1:4]
        self.certificate = payload[15:]
        assert len(self.certificate) in (0, 100)

        index = int.from_bytes(self.draw(2), "big") or 1
        ephemeral = X25519PrivateKey.from_private_bytes(self.draw(32))
        public = ephemeral.public_key().public_bytes_raw()
        header = struct.pack(">BBHH", 2, suite, index, remote_index)
        noise.mix_hash(public)
        noise.mix_key(public)
        noise.mix_key(_x25519(ephemeral, remote))
        message = header + public
        if suite in GROUPS:
            self.encapsulated = self._encapsulate(suite, share)
            ciphertext, secret = self.encapsulated
            message += noise.seal(ciphertext)
            noise.mix_key(secret)
        noise.mix_key(_x25519(ephemeral, self.initiator_public))
        noise.mix_key_and_hash(self.psk)
        message += noise.seal(header[1:] + self.parameters.encode())
        message += _hmac(_sha256(VERSION + b" mac1" + self.initiator_public), message)[:16] + bytes(16)
        agreed = _agree(self.parameters, payload[3:15])
        return message, Session(noise, agreed, index, remote_index, is_initiator=False)

    def _encapsulate(self, suite: int, share: bytes) -> tuple[bytes, bytes]:
        if suite in FFDHE:
            exponent = int.from_bytes(self.draw(64), "big")
            return _power(suite, 2, exponent), _power(suite, int.from_bytes(share, "big"), exponent)
        mlkem = MLKEM768PublicKey if suite == MLKEM768 else MLKEM1024PublicKey
        secret, ciphertext = mlkem.from_public_bytes(share).encapsulate()
        return ciphertext, secret


def _start(suite: int, responder_public: bytes) -> Noise:
    group = GROUPS.get(suite)
    pattern = f"IKhfs+psk2_25519+{group}" if group else "IKpsk2_25519"
    return Noise(f"Noise_{pattern}_ChaChaPoly_SHA256".encode(), VERSION + bytes([suite]), responder_public)


def _power(suite: int, base: int, exponent: int) -> bytes:
    prime = ffdhe_prime(suite)
    assert 2 <= base <= prime - 2
    return pow(base, exponent, prime).to_bytes(FFDHE[suite][0] // 8, "big")


def _x25519(private: X25519PrivateKey, public: bytes) -> bytes:
    return private.exchange(X25519PublicKey.from_public_bytes(public))
