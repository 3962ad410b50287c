"""Attacks on the key exchange: altered or replaced keys, suites, headers and MACs.

With the receiver's public key, the attacker computes a valid ``mac1`` for the altered message. Without it, the
receiver drops the message at the check of ``mac1``.
"""

from __future__ import annotations

from uavlinkd.lab.mitm.anatomy import (
    DatagramKind,
    Parts,
    has_certificate,
    kind_of,
    message_bytes,
    parts_of,
    with_changed_byte,
    with_mac1,
)
from uavlinkd.lab.mitm.attack import Alteration, Direction
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.suites import SUITES_BY_NAME, X25519

FIELD_PRIME = 2**255 - 19
"""Of X25519 (RFC 7748, section 4.1)."""
TAMPERED_BYTES = 4
ELEMENTS: dict[str, bytes] = {
    "zero": bytes(32),
    "one": (1).to_bytes(32, "little"),
    "p-1": (FIELD_PRIME - 1).to_bytes(32, "little"),
    "p": FIELD_PRIME.to_bytes(32, "little"),
    "p+1": (FIELD_PRIME + 1).to_bytes(32, "little"),
    # The two u-coordinates of order 8 (RFC 7748, section 6.1). A test computes that their shared secret is zero.
    "order-8": bytes.fromhex("e0eb7a7c3b41b8ae1656e3faf19fc46ada098deb9c32b1fd866205165f49b800"),
    "order-8-other": bytes.fromhex("5f9c95bca3508c24b1d0b1559c83ef5b04445cc4581c8e86d8224eddd09f1157"),
    "largest": b"\xff" * 32,
}
"""Invalid public keys. All except ``largest`` lead to a shared secret that the attacker knows."""


class MessageAlteration(Alteration, message="handshake", beside=False):
    """An alteration of well-formed handshake messages."""

    def is_target(self, datagram: bytes) -> bool:
        parts = parts_of(datagram)
        return parts is not None and self.options.message in ("handshake", parts.kind)


class FieldAlteration(MessageAlteration, repair_mac1=True):
    """Changes fields, then computes ``mac1``, if requested and possible."""

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        parts = parts_of(datagram)
        assert parts is not None
        changed, detail = self.change(parts)
        public_key = self.context.public_keys.get(direction.receiver) if self.options.repair_mac1 else None
        mac1 = "stale" if public_key is None else "repaired"
        return with_mac1(changed.join(), public_key), f"{detail}, mac1 {mac1}"

    def change(self, parts: Parts) -> tuple[Parts, str]:
        """The altered message with the old ``mac1``, and a description of the change."""
        raise NotImplementedError

    def replaced(self, parts: Parts) -> tuple[Parts, str]:
        # Every number below the prime is the u-coordinate of a point on the curve or its twist.
        key = self.rng.randrange(2, FIELD_PRIME - 1).to_bytes(32, "little")
        return parts._replace(ephemeral=key), f"public key replaced by {key[:4].hex()}…"


class TamperKey(FieldAlteration, name="tamper-key"):
    """Alters some bytes of the ephemeral public key in handshake messages."""

    def change(self, parts: Parts) -> tuple[Parts, str]:
        at = self.rng.randrange(len(parts.ephemeral) - TAMPERED_BYTES + 1)
        key = parts.ephemeral
        for position in range(at, at + TAMPERED_BYTES):
            key = with_changed_byte(key, position, self.rng)
        return parts._replace(ephemeral=key), f"bytes {at} to {at + TAMPERED_BYTES - 1} of the public key altered"


class ReplaceKey(FieldAlteration, name="replace-key"):
    """Replaces the ephemeral public key in handshake messages."""

    def change(self, parts: Parts) -> tuple[Parts, str]:
        return self.replaced(parts)


class RandomKey(TamperKey, name="random"):
    """Alters or replaces the public key at random, independently in each direction."""

    def change(self, parts: Parts) -> tuple[Parts, str]:
        return super().change(parts) if self.rng.random() < 0.5 else self.replaced(parts)


class SuiteDowngrade(FieldAlteration, name="suite-downgrade"):
    """Changes the suite of a handshake message to x25519, or that to ffdhe2048, and its length accordingly."""

    def change(self, parts: Parts) -> tuple[Parts, str]:
        suite = SUITES_BY_NAME["ffdhe2048"] if parts.suite is X25519 else X25519
        changed = parts._replace(header=bytes((parts.header[0], suite.number)) + parts.header[2:])
        certificate = wire.CERTIFICATE_BYTES if has_certificate(parts.join()) else 0
        room = message_bytes(parts.kind, suite) + certificate - (len(changed.join()) - len(parts.share))
        share = (parts.share + self.rng.randbytes(max(0, room - len(parts.share))))[:room]
        return changed._replace(share=share), f"suite {parts.suite.name} to {suite.name}"


class CertificateLength(FieldAlteration, name="certificate-length", message="initiation"):
    """Cuts the bytes of a certificate off initiations that have one, and adds as many to those without.

    The length says whether an initiation carries a certificate.
    """

    def change(self, parts: Parts) -> tuple[Parts, str]:
        size = wire.CERTIFICATE_BYTES
        if has_certificate(parts.join()):
            return parts._replace(rest=parts.rest[:-size]), "certificate cut off"
        return parts._replace(rest=parts.rest + self.rng.randbytes(size)), "certificate added"


class InvalidElement(FieldAlteration, name="invalid-element"):
    """Replaces the ephemeral X25519 key by 0, 1, p-1, p, p+1 or a point of low order, in turn.

    The shares of FFDHE and ML-KEM are encrypted, so only ``corrupt-share`` applies to them.
    """

    def change(self, parts: Parts) -> tuple[Parts, str]:
        name = list(ELEMENTS)[(self.attempts - 1) % len(ELEMENTS)]
        return parts._replace(ephemeral=ELEMENTS[name]), f"public key is {name}"


class CorruptShare(FieldAlteration, name="corrupt-share"):
    """Alters the encrypted FFDHE or ML-KEM share or ciphertext, in suites that have one."""

    def is_target(self, datagram: bytes) -> bool:
        parts = parts_of(datagram)
        return parts is not None and bool(parts.share) and super().is_target(datagram)

    def change(self, parts: Parts) -> tuple[Parts, str]:
        at = self.rng.randrange(len(parts.share))
        return parts._replace(share=with_changed_byte(parts.share, at, self.rng)), f"byte {at} of the share altered"


class AlterIndices(FieldAlteration, name="alter-indices", field="both"):
    """Alters the session indices in the header of handshake messages."""

    def is_target(self, datagram: bytes) -> bool:
        has_index = self.options.field != "receiver" or kind_of(datagram) is DatagramKind.RESPONSE
        return has_index and super().is_target(datagram)

    def change(self, parts: Parts) -> tuple[Parts, str]:
        header = bytearray(parts.header)
        changed: list[str] = []
        for at in {"sender": (2,), "receiver": (4,), "both": (2, 4)}[self.options.field]:
            if at < len(header):
                old = int.from_bytes(header[at : at + 2], "big")
                new = (old + self.rng.randrange(1, 2**16 - 1)) % 2**16
                header[at : at + 2] = new.to_bytes(2, "big")
                changed.append(f"index {old} to {new}")
        return parts._replace(header=bytes(header)), ", ".join(changed)


class AlterMacs(MessageAlteration, name="alter-macs", mac="mac1"):
    """Alters mac1 or mac2 of handshake messages."""

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        begin = len(datagram) - (wire.MACS_BYTES if self.options.mac == "mac1" else c.MAC_BYTES)
        at = begin + self.rng.randrange(c.MAC_BYTES)
        return with_changed_byte(datagram, at, self.rng), f"{self.options.mac} altered"
