"""The Noise handshake (Noise Protocol Framework, revision 34), both roles: IKpsk2 and IKhfs+psk2.

Letters are the Noise specification's: s and e are static and ephemeral keys, rs and re the remote ones,
h the transcript hash, ck the chaining key, k and n the cipher's key and nonce.

A state is frozen. Consuming a message computes the next state from the old one, so a forged message
leaves no trace: the old state still exists, and the genuine message completes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

from uavlinkd.core.constants import AEAD_TAG_BYTES, KEY_BYTES
from uavlinkd.core.crypto import AeadKey, Entropy, KeyPair, Secret, hmac_sha256, sha256
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.kem import Kem, KemPrivateKey, kem_of
from uavlinkd.core.suites import Suite


class Token(Enum):
    """One step of a message pattern (Noise, section 7; e1 and ekem1: the extension noise_hfs_spec)."""

    E = "e"
    S = "s"
    EE = "ee"
    ES = "es"
    SE = "se"
    SS = "ss"
    PSK = "psk"
    E1 = "e1"
    EKEM1 = "ekem1"


_E, _S, _EE, _ES, _SE, _SS = Token.E, Token.S, Token.EE, Token.ES, Token.SE, Token.SS
_PSK, _E1, _EKEM1 = Token.PSK, Token.E1, Token.EKEM1


@dataclass(frozen=True, slots=True)
class Pattern:
    """A two-message handshake in which the initiator knows the responder's static key (``<- s``)."""

    name: str
    initiation: tuple[Token, ...]
    response: tuple[Token, ...]

    @property
    def has_psk(self) -> bool:
        """With a PSK anywhere, every ``e`` is also mixed into the key (Noise, section 9.2)."""
        return _PSK in self.initiation + self.response


# The protocol uses the last two. The others are in the published test vectors of Noise.
IK = Pattern("IK", (_E, _ES, _S, _SS), (_E, _EE, _SE))
IK_PSK1 = Pattern("IKpsk1", (_E, _ES, _S, _SS, _PSK), (_E, _EE, _SE))
IK_PSK2 = Pattern("IKpsk2", (_E, _ES, _S, _SS), (_E, _EE, _SE, _PSK))
IK_HFS_PSK2 = Pattern("IKhfs+psk2", (_E, _ES, _E1, _S, _SS), (_E, _EE, _EKEM1, _SE, _PSK))

NO_PSK = Secret(bytes(KEY_BYTES))
"""Where a pair shares no PSK."""


@dataclass(frozen=True, slots=True, repr=False)
class SymmetricState:
    """Noise, section 5.2, with the CipherState of section 5.1 inside. Frozen: each step gives the next state."""

    ck: bytes
    h: bytes
    k: AeadKey | None = None
    n: int = 0

    @classmethod
    def initialize(cls, protocol_name: bytes) -> SymmetricState:
        """InitializeSymmetric."""
        h = sha256(protocol_name) if len(protocol_name) > KEY_BYTES else protocol_name.ljust(KEY_BYTES, b"\0")
        return cls(ck=h, h=h)

    def mix_hash(self, data: bytes) -> SymmetricState:
        """h = HASH(h || data)."""
        return replace(self, h=sha256(self.h + data))

    def mix_key(self, material: bytes) -> SymmetricState:
        """ck, k = HKDF(ck, material)."""
        ck, k = hkdf(self.ck, material, 2)
        return replace(self, ck=ck, k=AeadKey(k), n=0)

    def mix_key_and_hash(self, material: bytes) -> SymmetricState:
        """ck, temp_h, k = HKDF(ck, material); the PSK goes in here."""
        ck, temp_h, k = hkdf(self.ck, material, 3)
        return replace(self, ck=ck, h=sha256(self.h + temp_h), k=AeadKey(k), n=0)

    def encrypt_and_hash(self, plaintext: bytes) -> tuple[SymmetricState, bytes]:
        """The next state, and the ciphertext under k with h as associated data."""
        ciphertext = plaintext if self.k is None else self.k.seal(self.n, plaintext, self.h)
        return replace(self, h=sha256(self.h + ciphertext), n=self.n + 1), ciphertext

    def decrypt_and_hash(self, ciphertext: bytes) -> tuple[SymmetricState, bytes]:
        """The next state, and the plaintext.

        Raises:
            Drop: ``BAD_HANDSHAKE`` where the tag does not verify.
        """
        plaintext = ciphertext if self.k is None else self.k.open(self.n, ciphertext, self.h)
        if plaintext is None:
            raise Drop(DropReason.BAD_HANDSHAKE)
        return replace(self, h=sha256(self.h + ciphertext), n=self.n + 1), plaintext

    def split(self) -> tuple[Secret, Secret]:
        """The two transport keys: the initiator sends under the first, the responder under the second."""
        first, second = hkdf(self.ck, b"", 2)
        return Secret(first), Secret(second)


def hkdf(chaining_key: bytes, material: bytes, outputs: int) -> tuple[bytes, ...]:
    """HKDF of Noise, section 4.3: ``outputs`` (2 or 3) blocks of 32 bytes."""
    temp_key = hmac_sha256(chaining_key, material)
    blocks: list[bytes] = []
    for number in range(1, outputs + 1):
        blocks.append(hmac_sha256(temp_key, (blocks[-1] if blocks else b"") + bytes((number,))))
    return tuple(blocks)


def protocol_name(pattern: Pattern, suite: Suite) -> bytes:
    """The Noise protocol name, for example ``Noise_IKhfs+psk2_25519+MLKEM768_ChaChaPoly_SHA256``."""
    group = f"+{suite.name.upper()}" if suite.has_group else ""
    return f"Noise_{pattern.name}_25519{group}_ChaChaPoly_SHA256".encode()


@dataclass(frozen=True, slots=True, repr=False)
class HandshakeState:
    """Noise, section 5.3, for one handshake; see :func:`initiator` and :func:`responder`.

    :meth:`write` and :meth:`read` return the next state; this one stays as it was, whatever came.
    """

    pattern: Pattern
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

    def with_psk(self, psk: Secret) -> HandshakeState:
        """The same state once the responder knows from message 1 with whom it speaks."""
        return replace(self, psk=psk)

    def write(self, tokens: tuple[Token, ...], payload: bytes, entropy: Entropy) -> tuple[HandshakeState, bytes]:
        """WriteMessage: the next state and the message.

        Raises:
            Drop: ``INVALID_KEY_SHARE`` if the other side's share is invalid.
        """
        state, parts = self, []
        for token in tokens:
            symmetric = state.symmetric
            if token is Token.E:
                e = KeyPair(entropy(KEY_BYTES))
                parts.append(e.public)
                state = replace(state, e=e, symmetric=state._mix_ephemeral(e.public))
            elif token is Token.S:
                symmetric, sealed = symmetric.encrypt_and_hash(state.s.public)
                parts.append(sealed)
                state = replace(state, symmetric=symmetric)
            elif token is Token.E1:
                e1 = state._kem.generate(entropy)
                symmetric, sealed = symmetric.encrypt_and_hash(e1.share)
                parts.append(sealed)
                state = replace(state, e1=e1, symmetric=symmetric)
            elif token is Token.EKEM1:
                ciphertext, secret = state._kem.encapsulate(state.re1, entropy)
                symmetric, sealed = symmetric.encrypt_and_hash(ciphertext)
                parts.append(sealed)
                state = replace(state, symmetric=symmetric.mix_key(secret))
            else:
                state = state._mix(token)
        symmetric, sealed = state.symmetric.encrypt_and_hash(payload)
        parts.append(sealed)
        return replace(state, symmetric=symmetric), b"".join(parts)

    def read(self, tokens: tuple[Token, ...], message: bytes) -> tuple[HandshakeState, bytes]:
        """ReadMessage: the next state and the payload. A message that is too short fails as any forged one.

        Raises:
            Drop: ``BAD_HANDSHAKE`` or ``INVALID_KEY_SHARE``.
        """
        state, rest = self, message
        for token in tokens:
            symmetric = state.symmetric
            if token is Token.E:
                re, rest = rest[:KEY_BYTES], rest[KEY_BYTES:]
                state = replace(state, re=re, symmetric=state._mix_ephemeral(re))
            elif token is Token.S:
                sealed, rest = _cut(rest, KEY_BYTES + AEAD_TAG_BYTES)
                symmetric, rs = symmetric.decrypt_and_hash(sealed)
                state = replace(state, rs=rs, symmetric=symmetric)
            elif token is Token.E1:
                sealed, rest = _cut(rest, state.suite.share_bytes + AEAD_TAG_BYTES)
                symmetric, re1 = symmetric.decrypt_and_hash(sealed)
                state = replace(state, re1=re1, symmetric=symmetric)
            elif token is Token.EKEM1:
                sealed, rest = _cut(rest, state.suite.ciphertext_bytes + AEAD_TAG_BYTES)
                symmetric, ciphertext = symmetric.decrypt_and_hash(sealed)
                assert state.e1 is not None
                state = replace(state, symmetric=symmetric.mix_key(state.e1.decapsulate(ciphertext)))
            else:
                state = state._mix(token)
        symmetric, payload = state.symmetric.decrypt_and_hash(rest)
        return replace(state, symmetric=symmetric), payload

    @property
    def _kem(self) -> Kem:
        kem = kem_of(self.suite)
        assert kem is not None, "the pattern has a group, so the suite has one"
        return kem

    def _mix_ephemeral(self, public: bytes) -> SymmetricState:
        mixed = self.symmetric.mix_hash(public)
        return mixed.mix_key(public) if self.pattern.has_psk else mixed

    def _mix(self, token: Token) -> HandshakeState:
        """The tokens that send nothing: the key exchanges and the PSK."""
        if token is Token.PSK:
            return replace(self, symmetric=self.symmetric.mix_key_and_hash(self.psk.reveal()))
        # The first letter is the initiator's key, the second the responder's.
        ours, theirs = token.value if self.is_initiator else token.value[::-1]
        private = self.s if ours == "s" else self.e
        public = self.rs if theirs == "s" else self.re
        assert private is not None
        return replace(self, symmetric=self.symmetric.mix_key(private.exchange(public)))


def _cut(data: bytes, length: int) -> tuple[bytes, bytes]:
    return data[:length], data[length:]


def initiator(
    pattern: Pattern, suite: Suite, prologue: bytes, s: KeyPair, rs: bytes, psk: Secret = NO_PSK
) -> HandshakeState:
    """The side that sends message 1, to the holder of ``rs``."""
    return HandshakeState(pattern, suite, True, _start(pattern, suite, prologue, rs), s, rs, psk)


def responder(pattern: Pattern, suite: Suite, prologue: bytes, s: KeyPair, psk: Secret = NO_PSK) -> HandshakeState:
    """The side that waits for message 1."""
    return HandshakeState(pattern, suite, False, _start(pattern, suite, prologue, s.public), s, psk=psk)


def _start(pattern: Pattern, suite: Suite, prologue: bytes, responder_static: bytes) -> SymmetricState:
    symmetric = SymmetricState.initialize(protocol_name(pattern, suite))
    return symmetric.mix_hash(prologue).mix_hash(responder_static)  # the pre-message is "<- s"
