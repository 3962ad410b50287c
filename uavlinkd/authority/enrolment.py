"""The two lines of an enrolment: a member's request, and the operator's reply. README.md, section Enrolment.

Pure and total: any text is a line or a :class:`FleetError`, whose message is for a person. Neither line has a
secret, but the reply decides whom the new member trusts: compare the fingerprint at both ends.
"""

from __future__ import annotations

import base64
import struct
from typing import NamedTuple

from uavlinkd.authority.certificates import (
    BULLETIN_BYTES,
    FLEET_LABEL,
    NAME,
    Certificate,
    MemberRole,
    parse_certificate,
    role_bits,
    roles_in,
)
from uavlinkd.authority.trust import Trust
from uavlinkd.protocol.constants import KEY_BYTES
from uavlinkd.protocol.crypto import AuthorityKey, is_usable_public_key, sha256
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.suites import SUITES, Suite
from uavlinkd.protocol.wire import CERTIFICATE_BYTES
from uavlinkd.system.addresses import AddressError, parse_place
from uavlinkd.system.base64_text import from_base64, to_base64
from uavlinkd.system.terminal import UsageError

WORD = "uavlink-enroll-1"
VERSION = 2
CHECK_BYTES = 4
MOST_CONTACTS = 3
LONGEST_LINE = 4096  # More characters than three contacts need. A terminal accepts no longer line.
_HEAD = struct.Struct(f">BBBB{KEY_BYTES}s{CERTIFICATE_BYTES}sH")
_CONTACT = struct.Struct(f">{KEY_BYTES}s{CERTIFICATE_BYTES}sB")
_MOST_ADDRESS = 255  # its length is one byte
_CUT = "the line is not a whole line of `uavlinkd fleet sign`: it was cut or changed; copy it again, or send a file"


class FleetError(UsageError):
    """A command line, a line of an enrolment or a file of a fleet is wrong. The command changed nothing.

    Each message is for a person, says what to do, and contains no secret.
    """


def fingerprint_of(authority: bytes) -> str:
    """Eight characters by which persons compare the public key of an authority."""
    return _eight_characters(FLEET_LABEL + authority)


def _eight_characters(data: bytes) -> str:
    return base64.b32encode(sha256(data)[:5]).decode().lower()


def ids_of(certificate: Certificate) -> str:
    """The system ids of a certificate for a person; empty for a relay's."""
    first, last = certificate.system_ids
    return "" if not first else f"{first}" if first == last else f"{first}-{last}"


class Request(NamedTuple):
    """What a new member asks to be signed."""

    name: str
    public_key: bytes

    def line(self) -> str:
        key = to_base64(self.public_key)
        check = _eight_characters(f"{WORD} {self.name} {key}".encode())
        return f"{WORD} {self.name} {key} {check}"


def parse_request(line: str) -> Request:
    """The request in a line. Raises FleetError with the reason."""
    words = line.split()
    if words[:1] != [WORD] or len(words) != 4:
        raise FleetError("the line is not a whole line of `uavlinkd enroll NAME`: copy it again")
    check_name(words[1])
    request = Request(words[1], _decoded(words[2], "the line is not a line of `uavlinkd enroll NAME`: copy it again"))
    if len(request.public_key) != KEY_BYTES or request.line().split() != words:
        raise FleetError("the line was changed on its way: copy the line of `uavlinkd enroll NAME` again")
    if not is_usable_public_key(request.public_key):
        raise FleetError("the line has a public key of small order, with which no session is secret")
    return request


def check_name(name: str) -> None:
    """Check that a certificate can have this name. Raises FleetError if it cannot."""
    if not NAME.fullmatch(name):
        raise FleetError(f"{name!r:.80} is not a name: write 1 to 21 of a-z, 0-9 and -, first and last not -")


class Contact(NamedTuple):
    """A member that the others reach by address from the start."""

    public_key: bytes
    certificate: bytes
    addresses: tuple[str, ...]
    relays: bool

    def encode(self) -> bytes:
        return _CONTACT.pack(self.public_key, self.certificate, self.relays) + _encoded(self.addresses)


def _encoded(addresses: tuple[str, ...]) -> bytes:
    if any(len(text) > _MOST_ADDRESS for text in addresses):
        raise FleetError(f"an address in a line has at most {_MOST_ADDRESS} characters: write a shorter one")
    return bytes([len(addresses)]) + b"".join(bytes([len(text)]) + text.encode() for text in addresses)


class Reply(NamedTuple):
    """All that a member needs beside its private key."""

    suite: Suite
    calls: frozenset[MemberRole]  # members of these roles it connects to
    relays: bool  # whether it passes datagrams between members
    addresses: tuple[str, ...]  # Where others reach it. Without one it need not listen.
    authority: bytes
    certificate: bytes
    bulletin: bytes
    contacts: tuple[Contact, ...]

    def line(self) -> str:
        head = (VERSION, self.suite.number, role_bits(self.calls), self.relays, self.authority)
        data = _HEAD.pack(*head, self.certificate, len(self.bulletin)) + self.bulletin + _encoded(self.addresses)
        data += bytes([len(self.contacts)]) + b"".join(contact.encode() for contact in self.contacts)
        return to_base64(data + sha256(data)[:CHECK_BYTES]).rstrip("=")


def parse_reply(line: str) -> Reply:
    """The reply in a line; its signatures are not verified. Raises FleetError with the reason."""
    text = line.strip()
    if text.startswith(WORD):
        raise FleetError(
            "the line is the request of `uavlinkd enroll`: give it to `uavlinkd fleet sign`, whose line is meant"
        )
    data = _decoded(text + "=" * (-len(text) % 4), _CUT)
    if len(data) < _HEAD.size + BULLETIN_BYTES or sha256(data[:-CHECK_BYTES])[:CHECK_BYTES] != data[-CHECK_BYTES:]:
        raise FleetError(_CUT)
    if data[0] != VERSION:
        raise FleetError("the line is of another version of uavlinkd: install the same one at both ends")
    try:
        return _parsed(data[:-CHECK_BYTES])
    except (ValueError, LookupError, struct.error, Drop):
        text = "the line has a field that this version does not know: install the same one at both ends"
        raise FleetError(text) from None


def _parsed(data: bytes) -> Reply:
    _, suite, calls, relays, authority, certificate, size = _HEAD.unpack_from(data)
    parse_certificate(certificate)
    addresses, at = _addresses(data, _HEAD.size + size)
    count, at = data[at], at + 1
    contacts = []
    for _ in range(count):
        key, signed, flag = _CONTACT.unpack_from(data, at)
        texts, at = _addresses(data, at + _CONTACT.size)
        contacts.append(Contact(key, signed, texts, bool(flag)))
    bulletin = data[_HEAD.size : _HEAD.size + size]
    parts = (authority, certificate, bulletin, tuple(contacts))
    reply = Reply(SUITES[suite], roles_in(calls), bool(relays), addresses, *parts)
    is_same = base64.b64decode(reply.line() + "==")[:-CHECK_BYTES] == data  # one spelling of each reply
    if not is_same or count > MOST_CONTACTS or not all(contact.addresses for contact in contacts):
        raise ValueError("not canonical")
    return reply


def _addresses(data: bytes, at: int) -> tuple[tuple[str, ...], int]:
    texts, count, at = [], data[at], at + 1
    for _ in range(count):
        texts.append(data[at + 1 : at + 1 + data[at]].decode("ascii"))
        at += 1 + data[at]
    return tuple(texts), at


def verify_reply(reply: Reply, own_key: bytes) -> Trust:
    """Verify each signature of a reply for this static public key. The result holds the contacts' certificates.

    Raises FleetError with the reason.
    """
    try:
        authority = AuthorityKey(reply.authority)
        own = parse_certificate(reply.certificate)
        trust = Trust(authority, own_key, b"", reply.bulletin)
        for addresses in (reply.addresses, *(contact.addresses for contact in reply.contacts)):
            for address in addresses:
                parse_place(address)
    except AddressError as error:
        raise FleetError(f"the line has an address that {error}") from None
    except ValueError as error:
        raise FleetError(f"the line has no valid authority or bulletin: the key or bulletin {error}") from None
    if not trust.replace_own(reply.certificate):
        raise FleetError(f"the line has the certificate of another key, named {own.name}: use the line for this one")
    if trust.bulletin.refuses(own.serial):
        raise FleetError(f"the line has a revoked certificate, serial {own.serial}: sign the request again")
    for contact in reply.contacts:
        try:
            trust.hold(contact.public_key, contact.certificate)
        except Drop as drop:
            raise FleetError(
                f"the line has a contact without a valid certificate ({drop.reason}): sign again"
            ) from None
    return trust


def _decoded(text: str, reason: str) -> bytes:
    try:
        return from_base64(text)
    except ValueError:
        raise FleetError(reason) from None
