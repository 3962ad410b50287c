"""The suites: which group the extra ephemeral exchange uses, and how long its parts are. No cryptography here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Suite:
    """One key-exchange suite. X25519 authenticates in every one of them.

    ``share_bytes`` is the initiator's part, ``ciphertext_bytes`` the responder's; 0 without a group.
    ``work`` is what one encapsulation costs, in hundredths of that of ``ffdhe8192``; README.md, section 5.
    """

    number: int
    name: str
    share_bytes: int
    ciphertext_bytes: int
    work: int

    @property
    def has_group(self) -> bool:
        """Whether the handshake carries an extra exchange (Noise's hfs modifier)."""
        return self.share_bytes > 0


X25519 = Suite(0, "x25519", 0, 0, 0)

_ALL = (
    X25519,
    # RFC 7919, appendix A: a public value is as long as the modulus.
    Suite(1, "ffdhe2048", 256, 256, 12),
    Suite(2, "ffdhe3072", 384, 384, 21),
    Suite(3, "ffdhe4096", 512, 512, 32),
    Suite(4, "ffdhe6144", 768, 768, 74),
    Suite(5, "ffdhe8192", 1024, 1024, 100),
    # FIPS 203, table 3.
    Suite(16, "mlkem768", 1184, 1088, 1),
    Suite(17, "mlkem1024", 1568, 1568, 1),
)

SUITES: dict[int, Suite] = {suite.number: suite for suite in _ALL}
"""By the number on the wire."""
SUITES_BY_NAME: dict[str, Suite] = {suite.name: suite for suite in _ALL}
"""By the name in a configuration."""
