"""A WireGuard client written from the whitepaper alone, with an operating system that answers echo requests.

It shares no code with the package: HMAC and HKDF are spelled out, the checksums are sums of words.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from ipaddress import ip_address
from itertools import count

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

CONSTRUCTION = b"Noise_IKpsk2_25519_ChaChaPoly_BLAKE2s"
IDENTIFIER = b"WireGuard v1 zx2c4 Jason@zx2c4.com"


def _hash(*parts: bytes) -> bytes:
    return hashlib.blake2s(b"".join(parts)).digest()


def _mac(key: bytes, data: bytes) -> bytes:
    return hashlib.blake2s(data, digest_size=16, key=key).digest()


def _kdf(key: bytes, data: bytes, count: int) -> list[bytes]:
    def prf(secret: bytes, text: bytes) -> bytes:
        return hmac.new(secret, text, hashlib.blake2s).digest()

    first = prf(key, data)
    taus = [prf(first, b"\1")]
    while len(taus) < count:
        taus.append(prf(first, taus[-1] + bytes([len(taus) + 1])))
    return taus


def _nonce(counter: int) -> bytes:
    return struct.pack("<4xQ", counter)


def checksum(data: bytes) -> int:
    """The Internet checksum, word by word (RFC 1071)."""
    words: tuple[int, ...] = struct.unpack(f"!{(len(data) + 1) // 2}H", data + b"\0" * (len(data) % 2))
    total = sum(words)
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


class Client:
    """One station. ``clock`` returns seconds for timestamps, which only need to grow."""

    def __init__(self, daemon_key: bytes, host: str = "10.66.0.2", daemon_host: str = "10.66.0.1") -> None:
        self._private = X25519PrivateKey.generate()
        self.key = self._private.public_key().public_bytes_raw()
        self._daemon = daemon_key
        self.host, self.daemon_host = host, daemon_host
        self._stamp = 0
        self._send: ChaCha20Poly1305 | None = None
        self._receivers: dict[int, ChaCha20Poly1305] = {}
        self._unconfirmed: dict[int, tuple[bytes, int]] = {}
        self._indices = count(1)
        self.remote_index = 0
        self.counter = 0
        self.answers_pings = True

    def _dh(self, private: X25519PrivateKey, public: bytes) -> bytes:
        return private.exchange(X25519PublicKey.from_public_bytes(public))

    @property
    def is_open(self) -> bool:
        """Whether it has keys."""
        return self._send is not None

    def restart(self) -> None:
        """Forget all sessions."""
        self._send = None
        self._receivers.clear()
        self._unconfirmed.clear()

    def initiation(self) -> bytes:
        """The next initiation of the station."""
        self._ephemeral, self._index = X25519PrivateKey.generate(), next(self._indices)
        public, s = self._ephemeral.public_key().public_bytes_raw(), self._daemon
        ck = _hash(CONSTRUCTION)
        h = _hash(_hash(ck, IDENTIFIER), s)
        h, (ck,) = _hash(h, public), _kdf(ck, public, 1)
        ck, k = _kdf(ck, self._dh(self._ephemeral, s), 2)
        static = ChaCha20Poly1305(k).encrypt(_nonce(0), self.key, h)
        h = _hash(h, static)
        ck, k = _kdf(ck, self._dh(self._private, s), 2)
        self._stamp += 1
        stamp = ChaCha20Poly1305(k).encrypt(_nonce(0), struct.pack(">QI", 2**62 + self._stamp, 0), h)
        self._ck, self._h = ck, _hash(h, stamp)
        message = struct.pack("<II", 1, self._index) + public + static + stamp
        message += _mac(_hash(b"mac1----", s), message)
        return message + bytes(16)

    def awaits(self, message: bytes) -> bool:
        """Whether a response is to the newest initiation."""
        return message[8:12] == struct.pack("<I", self._index)

    def knows(self, message: bytes) -> bool:
        """Whether a data message is of a session that was not forgotten."""
        return int.from_bytes(message[4:8], "little") in self._receivers

    def on_response(self, message: bytes) -> None:
        """The daemon answered: use the keys from now on."""
        kind, sender, receiver = struct.unpack_from("<III", message)
        assert (kind, receiver, len(message)) == (2, self._index, 92)
        assert message[60:76] == _mac(_hash(b"mac1----", self.key), message[:60])
        remote, empty = message[12:44], message[44:60]
        h, (ck,) = _hash(self._h, remote), _kdf(self._ck, remote, 1)
        (ck,) = _kdf(ck, self._dh(self._ephemeral, remote), 1)
        (ck,) = _kdf(ck, self._dh(self._private, remote), 1)
        ck, tau, k = _kdf(ck, bytes(32), 3)
        assert ChaCha20Poly1305(k).decrypt(_nonce(0), empty, _hash(h, tau)) == b""
        send, receive = _kdf(ck, b"", 2)
        self._receivers[self._index] = ChaCha20Poly1305(receive)
        self._use(send, sender)

    def on_initiation(self, message: bytes) -> bytes:
        """The response to an initiation of the daemon. The keys are used when :meth:`on_data` opens something."""
        index = next(self._indices)
        kind, sender = struct.unpack_from("<II", message)
        assert (kind, len(message)) == (1, 148)
        ephemeral, ck = message[8:40], _hash(CONSTRUCTION)
        h = _hash(_hash(_hash(ck, IDENTIFIER), self.key), ephemeral)
        (ck,) = _kdf(ck, ephemeral, 1)
        ck, k = _kdf(ck, self._dh(self._private, ephemeral), 2)
        static = ChaCha20Poly1305(k).decrypt(_nonce(0), message[40:88], h)
        assert static == self._daemon
        h = _hash(h, message[40:88])
        ck, k = _kdf(ck, self._dh(self._private, static), 2)
        self.daemon_stamp = ChaCha20Poly1305(k).decrypt(_nonce(0), message[88:116], h)
        h = _hash(h, message[88:116])
        own = X25519PrivateKey.generate()
        public = own.public_key().public_bytes_raw()
        h, (ck,) = _hash(h, public), _kdf(ck, public, 1)
        (ck,) = _kdf(ck, self._dh(own, ephemeral), 1)
        (ck,) = _kdf(ck, self._dh(own, static), 1)
        ck, tau, k = _kdf(ck, bytes(32), 3)
        response = struct.pack("<III", 2, index, sender) + public
        response += ChaCha20Poly1305(k).encrypt(_nonce(0), b"", _hash(h, tau))
        response += _mac(_hash(b"mac1----", static), response)
        receive, send = _kdf(ck, b"", 2)
        self._receivers[index] = ChaCha20Poly1305(receive)
        self._unconfirmed = {index: (send, sender)}
        return response + bytes(16)

    def _use(self, send: bytes, index: int) -> None:
        self._send = ChaCha20Poly1305(send)
        self.remote_index, self.counter = index, 0

    def data(self, packet: bytes) -> bytes:
        """A data message with an inner packet."""
        assert self._send is not None
        counter, self.counter = self.counter, self.counter + 1
        padded = packet + bytes(-len(packet) % 16)
        header = struct.pack("<IIQ", 4, self.remote_index, counter)
        return header + self._send.encrypt(_nonce(counter), padded, b"")

    def udp(self, payload: bytes, port: int = 14550, to_port: int = 14550) -> bytes:
        """A data message with a UDP datagram to the daemon."""
        content = struct.pack("!HHHH", port, to_port, 8 + len(payload), 0) + payload
        pseudo = self._pseudo(17, len(content))
        content = content[:6] + struct.pack("!H", checksum(pseudo + content) or 0xFFFF) + payload
        return self.data(self.packet(17, content))

    def packet(self, protocol: int, content: bytes) -> bytes:
        """An inner packet to the daemon."""
        source, target = (ip_address(one).packed for one in (self.host, self.daemon_host))
        if len(source) == 16:
            return struct.pack("!IHBB", 6 << 28, len(content), protocol, 64) + source + target + content
        header = struct.pack("!BBHHHBBH", 0x45, 0, 20 + len(content), 1, 0x4000, 64, protocol, 0) + source + target
        return header[:10] + struct.pack("!H", checksum(header)) + header[12:] + content

    def _pseudo(self, protocol: int, size: int) -> bytes:
        source, target = (ip_address(one).packed for one in (self.host, self.daemon_host))
        if len(source) == 16:
            return source + target + struct.pack("!IxxxB", size, protocol)
        return source + target + struct.pack("!BBH", 0, protocol, size)

    def on_data(self, message: bytes) -> tuple[bytes, list[bytes]]:
        """The payload of a UDP datagram in a data message, if any, and what the operating system answers."""
        _, index, counter = struct.unpack_from("<IIQ", message)
        packet = self._receivers[index].decrypt(_nonce(counter), message[16:], b"")
        if index in self._unconfirmed:
            self._use(*self._unconfirmed.pop(index))
        if not packet:
            return b"", []
        is_six = packet[0] >> 4 == 6
        start = 40 if is_six else 20
        length = 40 + struct.unpack_from("!H", packet, 4)[0] if is_six else struct.unpack_from("!H", packet, 2)[0]
        protocol, content = packet[6 if is_six else 9], packet[start:length]
        if not is_six:
            assert checksum(packet[:20]) == 0
        if protocol == 17:
            return content[8:], []
        request, answer = (128, 129) if is_six else (8, 0)
        assert content[0] == request
        if not self.answers_pings:
            return b"", []
        reply = bytes([answer, 0, 0, 0]) + content[4:]
        summed = (self._pseudo(58, len(reply)) if is_six else b"") + reply
        reply = reply[:2] + struct.pack("!H", checksum(summed)) + reply[4:]
        return b"", [self.data(self.packet(58 if is_six else 1, reply))]
