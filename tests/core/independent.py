"""A second implementation of the initiator, written from ``uavlinkd/core/README.md`` alone.

It shares no code with the core: what the two agree on, the document says. It is the shortest program that links, and
no more: no timers, no replay window, no paths; how old its envelopes are the caller says.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import struct
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric.mlkem import MLKEM768PrivateKey, MLKEM1024PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

VERSION = b"uavlink/1"

X25519, FFDHE2048, MLKEM768, MLKEM1024 = 0, 1, 16, 17
GROUPS = {FFDHE2048: "FFDHE2048", MLKEM768: "MLKEM768", MLKEM1024: "MLKEM1024"}
CIPHERTEXT_BYTES = {FFDHE2048: 256, MLKEM768: 1088, MLKEM1024: 1568}


def _ffdhe2048() -> int:
    """RFC 7919, appendix A.1: 2^2048 - 2^1984 + (floor(2^1918 e) + 560316) 2^64 - 1."""
    numerator, denominator, k = 1, 1, 0  # e as one fraction: the sum of 1/k! far beyond 2048 bits
    while denominator.bit_length() < 2200:
        k += 1
        numerator, denominator = numerator * k + 1, denominator * k
    return 2**2048 - 2**1984 + ((2**1918 * numerator // denominator) + 560316) * 2**64 - 1


FFDHE2048_PRIME = _ffdhe2048()


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
    mac_key_bits: int = 256
    largest_envelope: int = 1232

    def encode(self) -> bytes:
        generation, confidential, *rest = self
        return struct.pack(">IHBBHH", generation, 0, int(confidential), *rest)


def _agree(ours: Parameters, encoded: bytes) -> Parameters:
    generation, _, flags, tag_bytes, mac_key_bits, largest = struct.unpack(">IHBBHH", encoded)
    confidential = ours.confidential or bool(flags & 1)
    return Parameters(
        max(ours.generation, generation) + 1,
        confidential,
        16 if confidential else max(ours.tag_bytes, tag_bytes),
        max(ours.mac_key_bits, mac_key_bits),
        min(ours.largest_envelope, largest),
    )


class Session:
    """Section 11, both directions."""

    def __init__(self, noise: Noise, agreed: Parameters, index: int, remote_index: int) -> None:
        self.parameters = agreed
        self.index, self.remote_index = index, remote_index
        self.counter = 0
        purpose = b" confidential" if agreed.confidential else b" authenticated"
        length = 32 if agreed.confidential else agreed.mac_key_bits // 8
        first, second = noise.split()
        self.send_key = _expand(first, VERSION + purpose + b" initiator to responder" + noise.h, length)
        self.receive_key = _expand(second, VERSION + purpose + b" responder to initiator" + noise.h, length)

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


def echo_request(token: int, received: int = 0, expected: int = 0) -> bytes:
    """Section 12."""
    return struct.pack(">BIII", 1, token, received, expected)


def echo_reply(request: bytes, fresh: int, received: int = 0, expected: int = 0) -> bytes:
    """Sections 11 and 12: ``fresh`` is of the session that carried the request."""
    kind, token, _, _ = struct.unpack(">BIII", request)
    assert kind == 1
    return struct.pack(">BIIII", 2, token, received, expected, fresh)


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
    ) -> None:
        self.static, self.responder_public = static, responder_public
        self.suite, self.psk = suite, psk
        self.parameters = Parameters() if parameters is None else parameters
        self.index = 1 + secrets.randbelow(65535)
        group = GROUPS.get(suite)
        pattern = f"IKhfs+psk2_25519+{group}" if group else "IKpsk2_25519"
        name = f"Noise_{pattern}_ChaChaPoly_SHA256".encode()
        self.noise = Noise(name, VERSION + bytes([suite]), responder_public)
        self.ephemeral = X25519PrivateKey.generate()
        self.exponent = secrets.randbits(512)
        self.mlkem = MLKEM768PrivateKey.generate() if suite == MLKEM768 else MLKEM1024PrivateKey.generate()
        self.mac1 = b""

    def initiation(self, cookie: bytes | None = None) -> bytes:
        """Message 1. Once for each Initiator."""
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
        message += noise.seal(header[1:] + self.parameters.encode())
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
        if self.suite == FFDHE2048:
            return pow(2, self.exponent, FFDHE2048_PRIME).to_bytes(256, "big")
        return self.mlkem.public_key().public_bytes_raw()

    def _decapsulate(self, ciphertext: bytes) -> bytes:
        if self.suite == FFDHE2048:
            value = int.from_bytes(ciphertext, "big")
            assert 2 <= value <= FFDHE2048_PRIME - 2
            return pow(value, self.exponent, FFDHE2048_PRIME).to_bytes(256, "big")
        return self.mlkem.decapsulate(ciphertext)


def _x25519(private: X25519PrivateKey, public: bytes) -> bytes:
    return private.exchange(X25519PublicKey.from_public_bytes(public))
