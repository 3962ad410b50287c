"""The extra ephemeral exchange of a suite, as key encapsulation: ``generate``, ``encapsulate``, ``decapsulate``.

FFDHE and ML-KEM look alike from outside. For FFDHE the ciphertext is the responder's public value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from uavlinkd.protocol import crypto
from uavlinkd.protocol.crypto import Entropy, Secret
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.suites import Suite

FFDHE_EXPONENT_BYTES = 64
"""512-bit exponents: beyond twice the strength of any of the groups (RFC 7919, section 5.2 asks for 225 to 400)."""
MLKEM_SEED_BYTES = 64
"""d || z (FIPS 203, section 7.1)."""

_FFDHE_OFFSETS = {2048: 560316, 3072: 2625351, 4096: 5736041, 6144: 15705020, 8192: 10965728}


class KemPrivateKey:
    """The initiator's ephemeral secret. It computes for one ciphertext only, the first that the responder sealed.

    An honest responder answers an initiation once. Without this, one that holds the keys could answer it many times
    and cause as much work each time. The same ciphertext in an altered copy of the response costs nothing again.
    """

    __slots__ = ("_compute", "_computed", "share")

    def __init__(self, share: bytes, compute: Callable[[bytes], bytes]) -> None:
        self.share = share
        """What goes to the responder."""
        self._compute = compute
        self._computed: tuple[bytes, Secret] | None = None

    def decapsulate(self, ciphertext: bytes) -> bytes:
        """The shared secret.

        Raises ``INVALID_KEY_SHARE``, or ``GROUP_BUDGET_SPENT`` for another ciphertext than the first.
        """
        if self._computed is None:
            self._computed = ciphertext, Secret(self._compute(ciphertext))
        first, secret = self._computed
        if ciphertext != first:
            raise Drop(DropReason.GROUP_BUDGET_SPENT)
        return secret.reveal()


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

    def generate(self, entropy: Entropy) -> KemPrivateKey:
        """A fresh key pair."""
        exponent = entropy(FFDHE_EXPONENT_BYTES)
        return KemPrivateKey(self.power(2, exponent), lambda value: self.power(self.element(value), exponent))

    def encapsulate(self, share: bytes, entropy: Entropy) -> tuple[bytes, bytes]:
        """The responder's public value, and the secret shared with the holder of ``share``.

        Raises ``INVALID_KEY_SHARE``.
        """
        base = self.element(share)  # refused before any work is done for it
        exponent = entropy(FFDHE_EXPONENT_BYTES)
        return self.power(2, exponent), self.power(base, exponent)

    def element(self, share: bytes) -> int:
        """The public value on the wire, checked to be in 2 ... p-2 (RFC 7919, section 5.1).

        Raises ``INVALID_KEY_SHARE``.
        """
        value = int.from_bytes(share, "big")
        if not 2 <= value <= ffdhe_prime(self.bits) - 2:
            raise Drop(DropReason.INVALID_KEY_SHARE)
        return value

    def power(self, base: int, exponent: bytes) -> bytes:
        """``base ** exponent`` in the group, as long as the modulus."""
        return crypto.ffdhe_power(ffdhe_prime(self.bits), base, exponent)


@dataclass(frozen=True, slots=True)
class Mlkem:
    """ML-KEM (FIPS 203); ``bits`` is 768 or 1024."""

    bits: int

    def generate(self, entropy: Entropy) -> KemPrivateKey:
        """A fresh key pair. An altered ciphertext gives another secret (implicit rejection), never an error."""
        return KemPrivateKey(*crypto.mlkem_generate(self.bits, entropy(MLKEM_SEED_BYTES)))

    def encapsulate(self, share: bytes, _entropy: Entropy) -> tuple[bytes, bytes]:
        """Ciphertext and secret; the randomness is the library's own. Raises as :func:`crypto.mlkem_encapsulate`."""
        return crypto.mlkem_encapsulate(self.bits, share)


_KEMS: dict[str, FfdheGroup | Mlkem] = {
    **{f"ffdhe{bits}": FfdheGroup(bits) for bits in _FFDHE_OFFSETS},
    "mlkem768": Mlkem(768),
    "mlkem1024": Mlkem(1024),
}


def kem_of(suite: Suite) -> FfdheGroup | Mlkem:
    """The group of a suite that has one."""
    return _KEMS[suite.name]
