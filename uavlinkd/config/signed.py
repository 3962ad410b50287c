"""The values of the line that an authority prints, in base64. Their signatures: :mod:`uavlinkd.config.fleet_rules`.

Each function raises ValueError, whose message does not repeat the text.
"""

from __future__ import annotations

from uavlinkd.authority.trust import HeldCertificate
from uavlinkd.core.certificates import NAME, parse_bulletin, parse_certificate
from uavlinkd.core.constants import KEY_BYTES
from uavlinkd.core.crypto import AuthorityKey
from uavlinkd.core.drops import Drop
from uavlinkd.system.base64_text import from_base64

ENROLL_AGAIN = "run `uavlinkd enroll --finish` again with the line of `uavlinkd fleet sign`"


def _decoded(text: str) -> bytes:
    try:
        return from_base64(text)
    except ValueError:
        raise ValueError(f"is not base64, or was cut: {ENROLL_AGAIN}") from None


def authority(text: str) -> AuthorityKey:
    data = _decoded(text)
    try:
        return AuthorityKey(data)
    except ValueError as error:
        raise ValueError(f"{error}: {ENROLL_AGAIN}") from None


def key_hash(text: str) -> bytes:
    if len(data := _decoded(text)) != KEY_BYTES:
        raise ValueError(f"is not a hash of {KEY_BYTES} bytes: {ENROLL_AGAIN}")
    return data


def certificate(text: str) -> HeldCertificate:
    data = _decoded(text)
    try:
        return HeldCertificate(parse_certificate(data), data)
    except Drop:
        raise ValueError(f"is not a certificate, or was cut: {ENROLL_AGAIN}") from None


def bulletin(text: str) -> bytes:
    if parse_bulletin(data := _decoded(text)) is None:
        raise ValueError(f"is not a bulletin, or was cut: {ENROLL_AGAIN}")
    return data


def member_name(text: str) -> str:
    if not NAME.fullmatch(text):
        raise ValueError("is not the name of a member: names have 1 to 21 of a-z, 0-9 and -")
    return text
