"""The extra ephemeral exchange of a suite, as key encapsulation: ``generate``, ``encapsulate``, ``decapsulate``.

FFDHE and ML-KEM look alike from outside. For FFDHE the ciphertext is the responder's public value.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Protocol

from uavlinkd.core import crypto
from uavlinkd.core.crypto import Entropy, MlkemPrivateKey, Secret
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.suites import Suite

FFDHE_EXPONENT_BYTES = 64
"""512-bit exponents: beyond twice the strength of any of the groups (RFC 7919, section 5.2 asks for 225 to 400)."""
MLKEM_SEED_BYTES = 64
"""d || z (FIPS 203, section 7.1)."""

_FFDHE_OFFSETS = {2048: 560316, 3072: 2625351, 4096: 5736041, 6144: 15705020, 8192: 10965728}


class KemPrivateKey(Protocol):
    """The initiator's ephemeral secret, for one decapsulation."""

    @property
    def share(self) -> bytes:
        """What goes to the responder."""

    def decapsulate(self, ciphertext: bytes) -> bytes:
        """The shared secret.

        Raises:
            Drop: ``INVALID_KEY_SHARE``.
        """


class OneCiphertext:
    """An ephemeral secret that computes for one ciphertext only, the first that the responder sealed.

    An honest responder answers an initiation once. Without this, one that holds the keys could answer it many times
    and cause as much work each time. The same ciphertext in an altered copy of the response costs nothing again.
    """

    __slots__ = ("_computed", "_key")

    def __init__(self, key: KemPrivateKey) -> None:
        self._key = key
        self._computed: tuple[bytes, Secret] | None = None

    @property
    def share(self) -> bytes:
        """What goes to the responder."""
        return self._key.share

    def decapsulate(self, ciphertext: bytes) -> bytes:
        """The shared secret.

        Raises:
            Drop: ``INVALID_KEY_SHARE``, or ``GROUP_BUDGET_SPENT`` for another ciphertext than the first.
        """
        if self._computed is None:
            self._computed = ciphertext, Secret(self._key.decapsulate(ciphertext))
        first, secret = self._computed
        if ciphertext != first:
            raise Drop(DropReason.GROUP_BUDGET_SPENT)
        return secret.reveal()


class Kem(Protocol):
    """One group."""

    def generate(self, entropy: Entropy) -> KemPrivateKey:
        """A fresh key pair."""

    def encapsulate(self, share: bytes, entropy: Entropy) -> tuple[bytes, bytes]:
        """Ciphertext and shared secret for the holder of ``share``.

        Raises:
            Drop: ``INVALID_KEY_SHARE``.
        """


@cache
def ffdhe_prime(bits: int) -> int:
    """The prime of RFC 7919, appendix A: 2^b - 2^(b-64) + (floor(2^(b-130) e) + X) 2^64 - 1."""
    guard = 64
    term = total = 1 << (bits - 130 + guard)
    divisor = 1
    while term:  # e = 1/0! + 1/1! + 1/2! + ...
        term //= divisor
        total += term
        divisor += 1
    middle = (total >> guard) + _FFDHE_OFFSETS[bits]
    return (1 << bits) - (1 << (bits - 64)) + (middle << 64) - 1


@dataclass(frozen=True, slots=True)
class FfdheGroup:
    """Diffie-Hellman in a safe-prime group of RFC 7919, generator 2."""

    bits: int

    def generate(self, entropy: Entropy) -> FfdhePrivateKey:
        """A fresh key pair."""
        exponent = entropy(FFDHE_EXPONENT_BYTES)
        return FfdhePrivateKey(self, exponent, self.power(2, exponent))

    def encapsulate(self, share: bytes, entropy: Entropy) -> tuple[bytes, bytes]:
        """The responder's public value, and the secret shared with the holder of ``share``."""
        base = self.element(share)  # refused before any work is done for it
        exponent = entropy(FFDHE_EXPONENT_BYTES)
        return self.power(2, exponent), self.power(base, exponent)

    def element(self, share: bytes) -> int:
        """The public value on the wire, checked to be in 2 ... p-2 (RFC 7919, section 5.1).

        Raises:
            Drop: ``INVALID_KEY_SHARE``.
        """
        value = int.from_bytes(share, "big")
        if not 2 <= value <= ffdhe_prime(self.bits) - 2:
            raise Drop(DropReason.INVALID_KEY_SHARE)
        return value

    def power(self, base: int, exponent: bytes) -> bytes:
        """``base ** exponent`` in the group, as long as the modulus."""
        return crypto.ffdhe_power(ffdhe_prime(self.bits), base, exponent)


@dataclass(frozen=True, slots=True)
class FfdhePrivateKey:
    """An ephemeral exponent and its public value."""

    group: FfdheGroup
    exponent: bytes = field(repr=False)
    share: bytes

    def decapsulate(self, ciphertext: bytes) -> bytes:
        """The secret shared with the sender of the public value ``ciphertext``."""
        return self.group.power(self.group.element(ciphertext), self.exponent)


@dataclass(frozen=True, slots=True)
class Mlkem:
    """ML-KEM (FIPS 203); ``bits`` is 768 or 1024."""

    bits: int

    def generate(self, entropy: Entropy) -> MlkemKeyPair:
        """A fresh key pair."""
        return MlkemKeyPair(*crypto.mlkem_generate(self.bits, entropy(MLKEM_SEED_BYTES)))

    def encapsulate(self, share: bytes, entropy: Entropy) -> tuple[bytes, bytes]:
        """Ciphertext and secret; the randomness is the library's own (see ``crypto.mlkem_encapsulate``)."""
        return crypto.mlkem_encapsulate(self.bits, share)


@dataclass(frozen=True, slots=True)
class MlkemKeyPair:
    """An ephemeral decapsulation key and its encapsulation key."""

    private: MlkemPrivateKey = field(repr=False)
    share: bytes

    def decapsulate(self, ciphertext: bytes) -> bytes:
        """The shared secret. An altered ciphertext gives another one (implicit rejection), never an error."""
        return self.private.decapsulate(ciphertext)


_KEMS: dict[str, Kem] = {
    **{f"ffdhe{bits}": FfdheGroup(bits) for bits in _FFDHE_OFFSETS},
    "mlkem768": Mlkem(768),
    "mlkem1024": Mlkem(1024),
}


def kem_of(suite: Suite) -> Kem | None:
    """The group of a suite; None for ``x25519``, which has no extra exchange."""
    return _KEMS.get(suite.name)
