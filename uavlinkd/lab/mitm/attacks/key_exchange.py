"""Attacks on the key exchange: keys altered or replaced, suites, headers and macs changed.

Whoever knows a receiver's public key can repair ``mac1`` behind an alteration, so that it reaches the cryptography;
without it the receiver turns the message away at the first HMAC.
"""

from __future__ import annotations

from random import Random
from typing import Literal

from pydantic import Field, field_validator

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.suites import SUITES_BY_NAME, X25519, Suite
from uavlinkd.lab.mitm.anatomy import Kind, Parts, kind_of, message_bytes, parts_of, with_mac1
from uavlinkd.lab.mitm.attack import Alteration, Options, Surroundings, Way, is_of

Message = Literal["handshake", "initiation", "response"]

FIELD_PRIME = 2**255 - 19
"""Of X25519 (RFC 7748, section 4.1)."""
_ORDER_8 = (
    # The two u of order 8 (RFC 7748, section 6.1, refers to the list; a test computes that they give all zeros).
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
"""Public values that no honest sender has. All but ``largest`` give a secret that everybody knows."""


class HandshakeOptions(Options):
    """Which messages, and whether ``mac1`` is repaired."""

    message: Message = Field("handshake", description="initiation, response, or both of them: handshake")
    repair_mac1: bool = Field(True, description="make mac1 fit again, where the receiver's public key is known")
    beside: bool = Field(False, description="let the genuine message pass too, behind the altered one")


class HandshakeAlteration(Alteration[HandshakeOptions]):
    """A change of whole handshake messages."""

    def is_target(self, datagram: bytes) -> bool:
        """Initiations and responses that are whole."""
        parts = parts_of(datagram)
        return parts is not None and is_of(self.options.message, datagram)

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """Change the parts, then ``mac1``."""
        parts = parts_of(datagram)
        assert parts is not None
        changed, detail = self.change(parts)
        return self.repaired(changed, way, detail)

    def repaired(self, datagram: bytes, way: Way, detail: str) -> tuple[bytes, str]:
        """With the ``mac1`` that fits, where that is asked for and possible."""
        public_key = self.surroundings.public_keys.get(way.receiver) if self.options.repair_mac1 else None
        return with_mac1(datagram, public_key), f"{detail}, mac1 {'stale' if public_key is None else 'repaired'}"

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """The altered message, ``mac1`` as it was, and what was done."""
        raise NotImplementedError

    def tampered(self, parts: Parts, size: int) -> tuple[bytes, str]:
        """So many bytes of the ephemeral public key altered."""
        at = self.chance.randrange(len(parts.ephemeral) - size + 1)
        mask = bytes(self.chance.randrange(1, 256) for _ in range(size))
        part = bytes(x ^ y for x, y in zip(parts.ephemeral[at : at + size], mask, strict=True))
        key = parts.ephemeral[:at] + part + parts.ephemeral[at + size :]
        return parts._replace(ephemeral=key).join(), f"bytes {at} to {at + size - 1} of the public key altered"

    def replaced(self, parts: Parts, key: bytes | None) -> tuple[bytes, str]:
        """Another ephemeral public key in place."""
        if key is None or key == parts.ephemeral:
            # Every number below the prime is the abscissa of a point, of the curve or of its twist: X25519 takes it.
            key = self.chance.randrange(2, FIELD_PRIME - 1).to_bytes(32, "little")
        return parts._replace(ephemeral=key).join(), f"public key replaced by {key[:4].hex()}…"


class TamperKeyOptions(HandshakeOptions):
    """Of ``tamper-key``."""

    size: int = Field(4, ge=1, le=c.KEY_BYTES, description="so many bytes of the key are altered")


class TamperKey(HandshakeAlteration):
    """Alters a part of the ephemeral public key in handshake messages."""

    name = "tamper-key"
    catalogue = ("H1", "H18")
    options_model = TamperKeyOptions
    options: TamperKeyOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Somewhere in the key."""
        return self.tampered(parts, self.options.size)


class ReplaceKeyOptions(HandshakeOptions):
    """Of ``replace-key``."""

    key: str | None = Field(None, description="public key to put in place, 64 hexadecimal digits; else a random one")

    @field_validator("key")
    @classmethod
    def _is_key(cls, value: str | None) -> str | None:
        if value is not None and len(bytes.fromhex(value)) != c.KEY_BYTES:
            raise ValueError("is 64 hexadecimal digits")
        return value


class ReplaceKey(HandshakeAlteration):
    """Puts another public key in place of the ephemeral one in handshake messages."""

    name = "replace-key"
    catalogue = ("H1",)
    options_model = ReplaceKeyOptions
    options: ReplaceKeyOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """The whole key."""
        key = self.options.key
        return self.replaced(parts, None if key is None else bytes.fromhex(key))


class RandomOptions(TamperKeyOptions):
    """Of ``random``."""

    tamper_share: float = Field(0.5, ge=0, le=1, description="share that is tampered with; the others are replaced")


class RandomKey(HandshakeAlteration):
    """Tampers with the public key or replaces it, by chance and for each direction independently."""

    name = "random"
    catalogue = ("H1", "H18")
    options_model = RandomOptions
    options: RandomOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """One of the two: an initiation goes one way, its response the other, and each draws for itself."""
        if self.chance.random() < self.options.tamper_share:
            return self.tampered(parts, self.options.size)
        return self.replaced(parts, None)


class SuiteOptions(HandshakeOptions):
    """Of ``suite-downgrade``."""

    suite: str = Field("x25519", description="the suite put in place; where it is that already, ffdhe2048")
    adapt_length: bool = Field(True, description="cut or pad the message to the length of that suite")

    @field_validator("suite")
    @classmethod
    def _is_suite(cls, value: str) -> str:
        if value not in SUITES_BY_NAME:
            raise ValueError(f"is one of {', '.join(SUITES_BY_NAME)}")
        return value


class SuiteDowngrade(HandshakeAlteration):
    """Changes the suite that a handshake message names, and its length with it."""

    name = "suite-downgrade"
    catalogue = ("H10", "H11")
    options_model = SuiteOptions
    options: SuiteOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """The suite byte; then the group's share goes or comes."""
        suite = self._other_than(parts.suite)
        header = bytes((parts.header[0], suite.number)) + parts.header[2:]
        changed = parts._replace(header=header)
        detail = f"suite {parts.suite.name} to {suite.name}"
        if not self.options.adapt_length:
            return changed.join(), f"{detail}, length kept"
        fixed = len(header) + c.KEY_BYTES + len(parts.rest) + len(parts.macs)
        room = message_bytes(parts.kind, suite) - fixed
        share = (parts.share + self.chance.randbytes(max(0, room - len(parts.share))))[:room]
        return changed._replace(share=share).join(), detail

    def _other_than(self, suite: Suite) -> Suite:
        wanted = SUITES_BY_NAME[self.options.suite]
        if wanted is not suite:
            return wanted
        return SUITES_BY_NAME["ffdhe2048"] if suite is X25519 else X25519


class ElementOptions(HandshakeOptions):
    """Of ``invalid-element``."""

    element: Literal["all", "zero", "one", "p-1", "p", "p+1", "order-8", "order-8-other", "largest"] = Field(
        "all", description="the value put in place; all: each in its turn"
    )


class InvalidElement(HandshakeAlteration):
    """Puts 0, 1, p-1, p, p+1 or a point of low order in place of the ephemeral X25519 key.

    The shares of FFDHE and ML-KEM are sealed on the wire: all that can be done to them is ``corrupt-share``.
    """

    name = "invalid-element"
    catalogue = ("H8", "H9")
    options_model = ElementOptions
    options: ElementOptions

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """The next of them."""
        names = list(ELEMENTS) if self.options.element == "all" else [self.options.element]
        name = names[(self.strikes - 1) % len(names)]
        return parts._replace(ephemeral=ELEMENTS[name]).join(), f"public key is {name}"


class CorruptShare(HandshakeAlteration):
    """Alters the sealed FFDHE or ML-KEM share or ciphertext, in suites that have one."""

    name = "corrupt-share"
    catalogue = ("H8",)
    options_model = HandshakeOptions

    def is_target(self, datagram: bytes) -> bool:
        """Messages with a group."""
        parts = parts_of(datagram)
        return parts is not None and bool(parts.share) and is_of(self.options.message, datagram)

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """One byte of it: it is sealed, so nothing can be put there that would mean something."""
        at = self.chance.randrange(len(parts.share))
        share = bytearray(parts.share)
        share[at] ^= self.chance.randrange(1, 256)
        return parts._replace(share=bytes(share)).join(), f"byte {at} of the share altered"


class HeaderOptions(HandshakeOptions):
    """Of ``alter-indices``."""

    field: Literal["sender", "receiver", "both"] = Field(
        "both", description="which index; initiations have no receiver"
    )
    value: Literal["random", "zero"] = Field("random", description="what is put in place")


class AlterIndices(HandshakeAlteration):
    """Alters the session indices in the clear header of handshake messages."""

    name = "alter-indices"
    catalogue = ("H5", "H18")
    options_model = HeaderOptions
    options: HeaderOptions

    def is_target(self, datagram: bytes) -> bool:
        """Messages that have the index."""
        return super().is_target(datagram) and (
            self.options.field != "receiver" or kind_of(datagram) is Kind.RESPONSE
        )

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Each index of the header that is asked for."""
        header = bytearray(parts.header)
        places = {"sender": (2,), "receiver": (4,), "both": (2, 4)}[self.options.field]
        changed: list[str] = []
        for at in places:
            if at < len(header):
                old = int.from_bytes(header[at : at + 2], "big")
                # Any other than the old one; the indices of a genuine message are never zero.
                new = 0 if self.options.value == "zero" else (old + self.chance.randrange(1, 2**16 - 1)) % 2**16
                header[at : at + 2] = new.to_bytes(2, "big")
                changed.append(f"index {old} to {new}")
        return parts._replace(header=bytes(header)).join(), ", ".join(changed)


class MacOptions(Options):
    """Of ``alter-macs``."""

    message: Message = Field("handshake", description="initiation, response, or both of them: handshake")
    mac: Literal["mac1", "mac2"] = Field("mac1", description="which of the two")
    beside: bool = Field(False, description="let the genuine message pass too, behind the altered one")


class AlterMacs(Alteration[MacOptions]):
    """Alters mac1 or mac2 of handshake messages."""

    name = "alter-macs"
    catalogue = ("H12", "H18", "H19")
    options_model = MacOptions

    def is_target(self, datagram: bytes) -> bool:
        """Whole messages."""
        return parts_of(datagram) is not None and is_of(self.options.message, datagram)

    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """One byte of it."""
        begin = len(datagram) - (wire.MACS_BYTES if self.options.mac == "mac1" else c.MAC_BYTES)
        altered = bytearray(datagram)
        altered[begin + self.chance.randrange(c.MAC_BYTES)] ^= self.chance.randrange(1, 256)
        return bytes(altered), f"{self.options.mac} altered"


class SpliceHandshake(HandshakeAlteration):
    """Joins the head of one handshake message with the body of the one before it in that direction."""

    name = "splice-handshake"
    catalogue = ("H5", "H18")
    options_model = HandshakeOptions

    def __init__(self, options: HandshakeOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._last: dict[tuple[Way, Kind, int], Parts] = {}
        self._before: dict[tuple[Way, Kind, int], Parts] = {}
        self._key: tuple[Way, Kind, int] | None = None

    def observe(self, datagram: bytes, way: Way, now: float) -> None:
        """Keep the last message of each kind and suite, and the one before."""
        parts = parts_of(datagram)
        self._key = None
        if parts is not None:
            self._key = (way, parts.kind, parts.suite.number)
            if self._key in self._last:
                self._before[self._key] = self._last[self._key]
            self._last[self._key] = parts

    def is_target(self, datagram: bytes) -> bool:
        """There was another before, and it was not the same."""
        if self._key is None or self._key not in self._before or not super().is_target(datagram):
            return False
        return self._before[self._key] != self._last[self._key]

    def change(self, parts: Parts) -> tuple[bytes, str]:
        """Header and ephemeral key of this, all that is sealed from the other."""
        assert self._key is not None
        before = self._before[self._key]
        return parts._replace(share=before.share, rest=before.rest).join(), "sealed parts of the message before"
