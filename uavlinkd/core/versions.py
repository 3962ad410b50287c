"""Initiations of another version of the protocol. README.md, section 18.

Two versions share only what a daemon needs to name the other: the first byte of an initiation, the place of mac1 and
the form of its label. Everything between may differ, so nothing of such a message is parsed.
"""

from __future__ import annotations

from collections.abc import Iterable

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.cookie import fits_mac1, mac1_key

OTHERS = tuple(version for version in range(1, c.LAST_KNOWN_VERSION + 1) if version != c.PROTOCOL_VERSION)
"""The versions that are compared."""


def version_of(initiation: bytes, public_keys: Iterable[bytes]) -> int | None:
    """The other version in which an initiation is for the holder of one of these keys.

    None for any other message: its sender does not know a key, or it was altered. A match proves that its sender
    knows the public key, and no more.
    """
    if not wire.MACS_BYTES < len(initiation) <= c.VERSION_CHECK_BYTES:
        return None
    for public_key in public_keys:
        for version in OTHERS:
            if fits_mac1(mac1_key(public_key, b"uavlink/%d" % version), initiation):
                return version
    return None
