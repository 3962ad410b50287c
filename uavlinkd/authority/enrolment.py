"""The two lines of an enrolment: a member's request, and the operator's reply. README.md, section Enrolment.

Pure and total: any text is a line or a :class:`FleetError`, whose message is for a person. Neither line has a
secret, but the reply decides whom the new member trusts: compare the fingerprint at both ends.
"""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any, NamedTuple

from uavlinkd.authority.certificates import (
    FLEET_LABEL,
    NAME,
    Bulletin,
    Certificate,
    parse_bulletin,
    parse_certificate,
)
from uavlinkd.protocol.constants import KEY_BYTES
from uavlinkd.protocol.crypto import is_usable_public_key, sha256
from uavlinkd.protocol.drops import Drop
from uavlinkd.system.base64_text import from_base64, to_base64
from uavlinkd.system.terminal import UsageError

WORD = "uavlink-enroll-1"
VERSION = 3
CHECK_BYTES = 4
MOST_CONTACTS = 3
LONGEST_LINE = 4096  # More characters than three contacts need. A terminal accepts no longer line.
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


def certificate_in(section: dict[str, Any]) -> Certificate:
    """The certificate of ``[fleet]`` or of a ``[[contact]]``. Raises LookupError, TypeError, ValueError or Drop."""
    return parse_certificate(from_base64(section["certificate"]))


class Reply(NamedTuple):
    """All that a member needs beside its private key, as it is in a configuration. Keys and signatures are base64."""

    fleet: dict[str, str]
    """Of ``[fleet]``: ``authority``, ``certificate`` and ``bulletin``."""
    calls: list[str]
    """The roles to whose members it connects."""
    contacts: list[dict[str, Any]]
    """Each ``[[contact]]``: ``public_key``, ``certificate``, ``addresses`` and ``relays``."""
    addresses: list[str]
    """Where others reach it. Without one it need not listen."""
    suite: str
    relays: bool
    """Whether it passes datagrams between members."""

    @property
    def authority(self) -> bytes:
        return from_base64(self.fleet["authority"])

    @property
    def certificate(self) -> Certificate:
        return certificate_in(self.fleet)

    @property
    def bulletin(self) -> Bulletin | None:
        return parse_bulletin(from_base64(self.fleet["bulletin"]))

    def line(self) -> str:
        data = zlib.compress(json.dumps([VERSION, *self], separators=(",", ":")).encode(), 9)
        return to_base64(data + sha256(data)[:CHECK_BYTES]).rstrip("=")


def parse_reply(line: str) -> Reply:
    """The reply in a line; its signatures are not verified. Raises FleetError with the reason."""
    text = line.strip()
    if text.startswith(WORD):
        raise FleetError(
            "the line is the request of `uavlinkd enroll`: give it to `uavlinkd fleet sign`, whose line is meant"
        )
    data = _decoded(text + "=" * (-len(text) % 4), _CUT)
    data, check = data[:-CHECK_BYTES], data[-CHECK_BYTES:]
    if sha256(data)[:CHECK_BYTES] != check:
        raise FleetError(_CUT)
    try:
        version, *fields = json.loads(zlib.decompress(data))  # of a line, at most 3 MB
        reply = Reply(*fields)
        is_known = version == VERSION and _has_types(reply) and len(reply.authority) == KEY_BYTES
        for section in (reply.fleet, *reply.contacts):
            certificate_in(section)
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError, zlib.error, Drop):
        is_known = False
    if not is_known:
        raise FleetError("the line has a field that this version does not know: install the same one at both ends")
    return reply


def _has_types(reply: Reply) -> bool:
    """Whether a reply has the fields of a configuration. The configuration's own rules check their values."""
    texts = [*reply.calls, *reply.addresses, reply.suite, *reply.fleet.values()]
    for contact in reply.contacts:
        texts += [contact["public_key"], contact["certificate"], *contact["addresses"]]
    relays = {type(flag) for flag in (reply.relays, *(contact["relays"] for contact in reply.contacts))}
    is_text = all(type(text) is str and text.isascii() for text in texts)
    has_keys = [4] * len(reply.contacts) == [*map(len, reply.contacts)] and len(reply.fleet) == 3
    return is_text and has_keys and relays == {bool} and reply.bulletin is not None


def _decoded(text: str, reason: str) -> bytes:
    try:
        return from_base64(text)
    except ValueError:
        raise FleetError(reason) from None
