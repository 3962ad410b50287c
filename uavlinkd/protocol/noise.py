"""The Noise handshake (Noise Protocol Framework, revision 34), both roles: IKpsk2, and with a group IKhfs+psk2.

Letters are the Noise specification's: s and e are static and ephemeral keys, rs and re the remote ones,
h the transcript hash, ck the chaining key, k and n the cipher's key and nonce.

A state is frozen. Consuming a message computes the next state from the old one, so a forged message
leaves no trace: the old state still exists, and the genuine message completes it.
"""

from __future__ import annotations

from typing import NamedTuple

from uavlinkd.protocol.constants import AEAD_TAG_BYTES, KEY_BYTES
from uavlinkd.protocol.crypto import AeadKey, Entropy, KeyPair, Secret, hkdf_expand, hmac_sha256, sha256
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.kem import KemPrivateKey, kem_of
from uavlinkd.protocol.suites import Suite

NO_PSK = Secret(bytes(KEY_BYTES))
"""Where a pair shares no PSK."""


def tokens_of(suite: Suite) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The steps of the two messages (Noise, section 7; e1 and ekem1: the extension noise_hfs_spec)."""
    if suite.has_group:
        return ("e", "es", "e1", "s", "ss"), ("e", "ee", "ekem1", "se", "psk")
    return ("e", "es", "s", "ss"), ("e", "ee", "se", "psk")


def protocol_name(suite: Suite) -> bytes:
    """The Noise protocol name, for example ``Noise_IKhfs+psk2_25519+MLKEM768_ChaChaPoly_SHA256``."""
    hfs, group = ("hfs+", f"+{suite.name.upper()}") if suite.has_group else ("", "")
    return f"Noise_IK{hfs}psk2_25519{group}_ChaChaPoly_SHA256".encode()


def hkdf(chaining_key: bytes, material: bytes, outputs: int) -> list[bytes]:
    """HKDF of Noise, section 4.3: ``outputs`` (2 or 3) blocks of 32 bytes."""
    output = hkdf_expand(hmac_sha256(chaining_key, material), b"", outputs * KEY_BYTES)
    return [output[at : at + KEY_BYTES] for at in range(0, len(output), KEY_BYTES)]


class SymmetricState(NamedTuple):
    """Noise, section 5.2, with the CipherState of section 5.1 inside. Frozen: each step gives the next state."""

    ck: bytes
    h: bytes
    k: AeadKey | None = None
    n: int = 0

    def __repr__(self) -> str:  # no secret in a log
        return "SymmetricState(...)"

    def mix_hash(self, data: bytes) -> SymmetricState:
        """h = HASH(h || data)."""
        return self._replace(h=sha256(self.h + data))

    def mix_key(self, material: bytes) -> SymmetricState:
        """ck, k = HKDF(ck, material)."""
        ck, k = hkdf(self.ck, material, 2)
        return self._replace(ck=ck, k=AeadKey(k), n=0)

    def mix_key_and_hash(self, material: bytes) -> SymmetricState:
        """ck, temp_h, k = HKDF(ck, material); the PSK goes in here."""
        ck, temp_h, k = hkdf(self.ck, material, 3)
        return self._replace(ck=ck, h=sha256(self.h + temp_h), k=AeadKey(k), n=0)

    def encrypt_and_hash(self, plaintext: bytes) -> tuple[SymmetricState, bytes]:
        """The next state, and the ciphertext under k with h as associated data."""
        assert self.k is not None, "the first token makes a key"
        ciphertext = self.k.seal(self.n, plaintext, self.h)
        return self._replace(h=sha256(self.h + ciphertext), n=self.n + 1), ciphertext

    def decrypt_and_hash(self, ciphertext: bytes) -> tuple[SymmetricState, bytes]:
        """The next state, and the plaintext. Raises ``BAD_HANDSHAKE`` where the tag does not verify."""
        assert self.k is not None, "the first token makes a key"
        plaintext = self.k.open(self.n, ciphertext, self.h)
        if plaintext is None:
            raise Drop(DropReason.BAD_HANDSHAKE)
        return self._replace(h=sha256(self.h + ciphertext), n=self.n + 1), plaintext

    def split(self) -> tuple[Secret, Secret]:
        """The two transport keys: the initiator sends under the first, the responder under the second."""
        first, second = hkdf(self.ck, b"", 2)
        return Secret(first), Secret(second)


class HandshakeState(NamedTuple):
    """Noise, section 5.3, for one handshake; see :func:`initiator` and :func:`responder`.

    :meth:`write` and :meth:`read` return the next state; this one stays as it was, whatever came.
    """

    suite: Suite
    is_initiator: bool
    symmetric: SymmetricState
    s: KeyPair
    rs: bytes = b""
    psk: Secret = NO_PSK
    e: KeyPair | None = None
    re: bytes = b""
    e1: KemPrivateKey | None = None
    re1: bytes = b""

    def __repr__(self) -> str:
        return "HandshakeState(...)"

    def write(self, payload: bytes, entropy: Entropy) -> tuple[HandshakeState, bytes]:
        """WriteMessage: the next state and the message.

        Raises ``INVALID_KEY_SHARE`` if the other side's share is invalid.
        """
        state, message = self, b""
        for step in tokens_of(self.suite)[not self.is_initiator]:
            part = b""
            if step == "e":  # mixed into the key too: the pattern has a PSK (Noise, section 9.2)
                e = KeyPair(entropy(KEY_BYTES))
                part = e.public
                state = state._replace(e=e, symmetric=state.symmetric.mix_hash(part).mix_key(part))
            elif step == "s":
                state, part = state._seal(state.s.public)
            elif step == "e1":
                e1 = kem_of(state.suite).generate(entropy)
                state, part = state._replace(e1=e1)._seal(e1.share)
            elif step == "ekem1":
                ciphertext, secret = kem_of(state.suite).encapsulate(state.re1, entropy)
                state, part = state._seal(ciphertext)
                state = state._mix_key(secret)
            else:
                state = state._mix(step)
            message += part
        state, part = state._seal(payload)
        return state, message + part

    def read(self, message: bytes) -> tuple[HandshakeState, bytes]:
        """ReadMessage: the next state and the payload. A message that is too short fails as any forged one.

        Raises ``BAD_HANDSHAKE`` or ``INVALID_KEY_SHARE``.
        """
        state, rest = self, message
        for step in tokens_of(self.suite)[self.is_initiator]:
            if step == "e":
                re, rest = rest[:KEY_BYTES], rest[KEY_BYTES:]
                state = state._replace(re=re, symmetric=state.symmetric.mix_hash(re).mix_key(re))
            elif step == "s":
                state, rs, rest = state._open(rest, KEY_BYTES)
                state = state._replace(rs=rs)
            elif step == "e1":
                state, re1, rest = state._open(rest, state.suite.share_bytes)
                state = state._replace(re1=re1)
            elif step == "ekem1":
                state, ciphertext, rest = state._open(rest, state.suite.ciphertext_bytes)
                assert state.e1 is not None
                state = state._mix_key(state.e1.decapsulate(ciphertext))
            else:
                state = state._mix(step)
        state, payload, _ = state._open(rest, len(rest))
        return state, payload

    def _seal(self, plaintext: bytes) -> tuple[HandshakeState, bytes]:
        symmetric, sealed = self.symmetric.encrypt_and_hash(plaintext)
        return self._replace(symmetric=symmetric), sealed

    def _open(self, data: bytes, size: int) -> tuple[HandshakeState, bytes, bytes]:
        """The next state, ``size`` bytes or fewer that were sealed in the data, and the data behind them."""
        sealed, rest = data[: size + AEAD_TAG_BYTES], data[size + AEAD_TAG_BYTES :]
        symmetric, plaintext = self.symmetric.decrypt_and_hash(sealed)
        return self._replace(symmetric=symmetric), plaintext, rest

    def _mix_key(self, secret: bytes) -> HandshakeState:
        return self._replace(symmetric=self.symmetric.mix_key(secret))

    def _mix(self, step: str) -> HandshakeState:
        """The tokens that send nothing: the key exchanges and the PSK."""
        if step == "psk":
            return self._replace(symmetric=self.symmetric.mix_key_and_hash(self.psk.reveal()))
        # The first letter is the initiator's key, the second the responder's.
        private = self.s if step[not self.is_initiator] == "s" else self.e
        public = self.rs if step[self.is_initiator] == "s" else self.re
        assert private is not None
        return self._mix_key(private.exchange(public))


def initiator(suite: Suite, prologue: bytes, s: KeyPair, rs: bytes, psk: Secret = NO_PSK) -> HandshakeState:
    """The side that sends message 1, to the holder of ``rs``."""
    return HandshakeState(suite, True, _start(suite, prologue, rs), s, rs, psk)


def responder(suite: Suite, prologue: bytes, s: KeyPair, psk: Secret = NO_PSK) -> HandshakeState:
    """The side that waits for message 1."""
    return HandshakeState(suite, False, _start(suite, prologue, s.public), s, psk=psk)


def _start(suite: Suite, prologue: bytes, responder_static: bytes) -> SymmetricState:
    h = sha256(protocol_name(suite))  # of the name, because it is longer than a hash
    return SymmetricState(ck=h, h=h).mix_hash(prologue).mix_hash(responder_static)  # the pre-message is "<- s"
