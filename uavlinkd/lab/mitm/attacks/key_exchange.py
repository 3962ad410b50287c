"""Attacks on the key exchange: altered or replaced keys, suites, headers and MACs.

With the receiver's public key, the attacker computes a valid ``mac1`` for the altered message. Without it, the
receiver drops the message at the check of ``mac1``.
"""

from __future__ import annotations

from random import Random
from typing import Literal

from pydantic import Field, field_validator

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.suites import SUITES_BY_NAME, X25519, Suite
from uavlinkd.lab.mitm.anatomy import DatagramKind, Parts, kind_of, message_bytes, parts_of, with_mac1
from uavlinkd.lab.mitm.attack import Alteration, AttackContext, Direction, Options
from uavlinkd.lab.mitm.kinds import matches_kind

Message = Literal["handshake", "initiation", "response"]

FIELD_PRIME = 2**255 - 19
"""Of X25519 (RFC 7748, section 4.1)."""
_ORDER_8 = (
    # The two u-coordinates of order 8 (RFC 7748, section 6.1). A test computes that their shared secret is zero.
    "e0eb7a7c3b41b8ae1656e3faf19fc46ada098deb9c32b1fd866205165f49b800",
    "5f9c95bca3508c24b1d0b1559c83ef5b04445cc4581c8e86d8224eddd09f1157",
)
ELEMENTS: dict[str, bytes] = {
    "zero": bytes(32),
    "one": (1).to_bytes(32, "little"),
    "p-1": (FIELD_PRIME - 1).to_bytes(32, "little"),
    "p": FIELD_PRIME.to_bytes(32, "little"),
    "p+1": (FIELD_PRIME + 1).to_bytes(32, "little"),
    "order-8": bytes.fromhex(_ORDER_8[0]),
    "order-8-other": bytes.fromhex(_ORDER_8[1]),
    "largest": b"\xff" * 32,
}
"""Invalid public keys. All except ``largest`` lead to a shared secret that the attacker knows."""


class HandshakeOptions(Options):
    """The parameters of alterations of handshake messages."""

    message: Message = Field("handshake", description="initiation, response, or handshake for both")
    repair_mac1: bool = Field(True, description="compute a valid mac1, if the receiver's public key is known")
    beside: bool = Field(False, description="also pass the genuine message, after the altered one")


class HandshakeAlteration(Alteration[HandshakeOptions]):
    """An alteration of well-formed handshake messages."""

    def is_target(self, datagram: bytes) -> bool:
        """Well-formed messages of the selected kinds."""
        parts = parts_of(datagram)
        return parts is not None and matches_kind(self.options.message, datagram)

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """Change the fields, then ``mac1``."""
        parts = parts_of(datagram)
        assert parts is not None
        changed, detail = self.change(parts)
        return self.repaired(changed, direction, detail)

    def repaired(self, datagram: bytes, direction: Direction, detail: str) -> tuple[bytes, str]:
        """Compute a valid ``mac1``, if requested and possible."""
        public_key = self.context.public_keys.get(direction.receiver) if self.options.repair_mac1 else None
        return with_mac1(datagram, public_key), f"{detail}, mac1 {'stale' if public_key is None else 'repaired'}"

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """The altered message with the old ``mac1``, and a description of the change."""
        raise NotImplementedError

    def tampered(self, parts: Parts, size: int) -> tuple[bytes, str]:
        """Alter ``size`` bytes of the ephemeral public key."""
        at = self.rng.randrange(len(parts.ephemeral) - size + 1)
        mask = bytes(self.rng.randrange(1, 256) for _ in range(size))
        part = bytes(x ^ y for x, y in zip(parts.ephemeral[at : at + size], mask, strict=True))
        key = parts.ephemeral[:at] + part + parts.ephemeral[at + size :]
        return parts._replace(ephemeral=key).join(), f"bytes {at} to {at + size - 1} of the public key altered"

    def replaced(self, parts: Parts, key: bytes | None) -> tuple[bytes, str]:
        """Replace the ephemeral public key."""
        if key is None or key == parts.ephemeral:
            # Every number below the prime is the u-coordinate of a point on the curve or its twist.
            key = self.rng.randrange(2, FIELD_PRIME - 1).to_bytes(32, "little")
        return parts._replace(ephemeral=key).join(), f"public key replaced by {key[:4].hex()}…"


class TamperKeyOptions(HandshakeOptions):
    """The parameters of ``tamper-key``."""

    size: int = Field(4, ge=1, le=c.KEY_BYTES, description="number of altered bytes of the key")


class TamperKey(HandshakeAlteration):
    """Alters some bytes of the ephemeral public key in handshake messages."""

    name = "tamper-key"
    catalogue = ("H1", "H18")
    options_model = TamperKeyOptions
    options: TamperKeyOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Alter bytes at a random position."""
        return self.tampered(parts, self.options.size)


class ReplaceKeyOptions(HandshakeOptions):
    """The parameters of ``replace-key``."""

    key: str | None = Field(None, description="the new public key, 64 hexadecimal digits; by default a random one")

    @field_validator("key")
    @classmethod
    def _is_key(cls, value: str | None) -> str | None:
        if value is not None and len(bytes.fromhex(value)) != c.KEY_BYTES:
            raise ValueError("must be 64 hexadecimal digits")
        return value


class ReplaceKey(HandshakeAlteration):
    """Replaces the ephemeral public key in handshake messages."""

    name = "replace-key"
    catalogue = ("H1",)
    options_model = ReplaceKeyOptions
    options: ReplaceKeyOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Replace the key."""
        key = self.options.key
        return self.replaced(parts, None if key is None else bytes.fromhex(key))


class RandomOptions(TamperKeyOptions):
    """The parameters of ``random``."""

    tamper_share: float = Field(0.5, ge=0, le=1, description="share of altered keys; the others are replaced")


class RandomKey(HandshakeAlteration):
    """Alters or replaces the public key at random, independently in each direction."""

    name = "random"
    catalogue = ("H1", "H18")
    options_model = RandomOptions
    options: RandomOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Alter or replace the key."""
        if self.rng.random() < self.options.tamper_share:
            return self.tampered(parts, self.options.size)
        return self.replaced(parts, None)


class SuiteOptions(HandshakeOptions):
    """The parameters of ``suite-downgrade``."""

    suite: str = Field("x25519", description="the new suite; ffdhe2048 if the message already has it")
    adapt_length: bool = Field(True, description="truncate or pad the message to the length of that suite")

    @field_validator("suite")
    @classmethod
    def _is_suite(cls, value: str) -> str:
        if value not in SUITES_BY_NAME:
            raise ValueError(f"must be one of {', '.join(SUITES_BY_NAME)}")
        return value


class SuiteDowngrade(HandshakeAlteration):
    """Changes the suite of a handshake message, and its length accordingly."""

    name = "suite-downgrade"
    catalogue = ("H10", "H11")
    options_model = SuiteOptions
    options: SuiteOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Change the suite byte, then truncate or pad the share of the group."""
        suite = self._other_than(parts.suite)
        header = bytes((parts.header[0], suite.number)) + parts.header[2:]
        changed = parts._replace(header=header)
        detail = f"suite {parts.suite.name} to {suite.name}"
        if not self.options.adapt_length:
            return changed.join(), f"{detail}, length kept"
        fixed = len(header) + c.KEY_BYTES + len(parts.rest) + len(parts.macs)
        room = message_bytes(parts.kind, suite) - fixed
        share = (parts.share + self.rng.randbytes(max(0, room - len(parts.share))))[:room]
        return changed._replace(share=share).join(), detail

    def _other_than(self, suite: Suite) -> Suite:
        wanted = SUITES_BY_NAME[self.options.suite]
        if wanted is not suite:
            return wanted
        return SUITES_BY_NAME["ffdhe2048"] if suite is X25519 else X25519


class ElementOptions(HandshakeOptions):
    """The parameters of ``invalid-element``."""

    element: Literal["all", "zero", "one", "p-1", "p", "p+1", "order-8", "order-8-other", "largest"] = Field(
        "all", description="the new value; all: each in turn"
    )


class InvalidElement(HandshakeAlteration):
    """Replaces the ephemeral X25519 key by 0, 1, p-1, p, p+1 or a point of low order.

    The shares of FFDHE and ML-KEM are encrypted, so only ``corrupt-share`` applies to them.
    """

    name = "invalid-element"
    catalogue = ("H8", "H9")
    options_model = ElementOptions
    options: ElementOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """The next value."""
        names = list(ELEMENTS) if self.options.element == "all" else [self.options.element]
        name = names[(self.attempts - 1) % len(names)]
        return parts._replace(ephemeral=ELEMENTS[name]).join(), f"public key is {name}"


class CorruptShare(HandshakeAlteration):
    """Alters the encrypted FFDHE or ML-KEM share or ciphertext, in suites that have one."""

    name = "corrupt-share"
    catalogue = ("H8",)
    options_model = HandshakeOptions

    def is_target(self, datagram: bytes) -> bool:
        """Messages with a share."""
        parts = parts_of(datagram)
        return parts is not None and bool(parts.share) and matches_kind(self.options.message, datagram)

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Alter one byte. The share is encrypted, so a chosen value is impossible."""
        at = self.rng.randrange(len(parts.share))
        share = bytearray(parts.share)
        share[at] ^= self.rng.randrange(1, 256)
        return parts._replace(share=bytes(share)).join(), f"byte {at} of the share altered"


class HeaderOptions(HandshakeOptions):
    """The parameters of ``alter-indices``."""

    field: Literal["sender", "receiver", "both"] = Field(
        "both", description="the altered index; initiations have no receiver index"
    )
    value: Literal["random", "zero"] = Field("random", description="the new value")


class AlterIndices(HandshakeAlteration):
    """Alters the session indices in the header of handshake messages."""

    name = "alter-indices"
    catalogue = ("H5", "H18")
    options_model = HeaderOptions
    options: HeaderOptions

    def is_target(self, datagram: bytes) -> bool:
        """Messages that have the index."""
        return super().is_target(datagram) and (
            self.options.field != "receiver" or kind_of(datagram) is DatagramKind.RESPONSE
        )

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Alter the selected indices."""
        header = bytearray(parts.header)
        places = {"sender": (2,), "receiver": (4,), "both": (2, 4)}[self.options.field]
        changed: list[str] = []
        for at in places:
            if at < len(header):
                old = int.from_bytes(header[at : at + 2], "big")
                # Different from the old index. The indices of a genuine message are never zero.
                new = 0 if self.options.value == "zero" else (old + self.rng.randrange(1, 2**16 - 1)) % 2**16
                header[at : at + 2] = new.to_bytes(2, "big")
                changed.append(f"index {old} to {new}")
        return parts._replace(header=bytes(header)).join(), ", ".join(changed)


class MacOptions(Options):
    """The parameters of ``alter-macs``."""

    message: Message = Field("handshake", description="initiation, response, or handshake for both")
    mac: Literal["mac1", "mac2"] = Field("mac1", description="the altered MAC")
    beside: bool = Field(False, description="also pass the genuine message, after the altered one")


class AlterMacs(Alteration[MacOptions]):
    """Alters mac1 or mac2 of handshake messages."""

    name = "alter-macs"
    catalogue = ("H12", "H18", "H19")
    options_model = MacOptions

    def is_target(self, datagram: bytes) -> bool:
        """Well-formed messages."""
        return parts_of(datagram) is not None and matches_kind(self.options.message, datagram)

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """Alter one byte."""
        begin = len(datagram) - (wire.MACS_BYTES if self.options.mac == "mac1" else c.MAC_BYTES)
        altered = bytearray(datagram)
        altered[begin + self.rng.randrange(c.MAC_BYTES)] ^= self.rng.randrange(1, 256)
        return bytes(altered), f"{self.options.mac} altered"


class SpliceHandshake(HandshakeAlteration):
    """Joins the header of one handshake message and the body of the one before it in that direction."""

    name = "splice-handshake"
    catalogue = ("H5", "H18")
    options_model = HandshakeOptions

    def __init__(self, options: HandshakeOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._last: dict[tuple[Direction, DatagramKind, int], Parts] = {}
        self._before: dict[tuple[Direction, DatagramKind, int], Parts] = {}
        self._key: tuple[Direction, DatagramKind, int] | None = None

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        """Record the last two messages of each kind and suite."""
        parts = parts_of(datagram)
        self._key = None
        if parts is not None:
            self._key = (direction, parts.kind, parts.suite.number)
            if self._key in self._last:
                self._before[self._key] = self._last[self._key]
            self._last[self._key] = parts

    def is_target(self, datagram: bytes) -> bool:
        """Messages that follow a different message."""
        if self._key is None or self._key not in self._before or not super().is_target(datagram):
            return False
        return self._before[self._key] != self._last[self._key]

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Header and ephemeral key of this message, encrypted parts of the one before."""
        assert self._key is not None
        before = self._before[self._key]
        return parts._replace(share=before.share, rest=before.rest).join(), "encrypted parts of the message before"
