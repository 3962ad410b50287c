"""The lines of an enrolment: what a valid one has, and why others are refused."""

from __future__ import annotations

import base64

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.authority.certificates import MOST_REVOKED, Bulletin, Certificate, MemberRole, fleet_id_of
from uavlinkd.authority.enrolment import (
    LONGEST_LINE,
    Contact,
    FleetError,
    Reply,
    Request,
    fingerprint_of,
    parse_reply,
    parse_request,
    verify_reply,
)
from uavlinkd.protocol.crypto import Secret, SigningKey, sha256, x25519_public_key
from uavlinkd.protocol.suites import SUITES, X25519

SIGNER = SigningKey(Secret(bytes(32)))
FLEET = fleet_id_of(SIGNER.public)
KEY, RELAY_KEY, OTHER_KEY = (x25519_public_key(bytes([number]) * 32) for number in (1, 2, 3))


def certified(key: bytes, serial: int, role: MemberRole, number: int, name: str) -> bytes:
    certificate = Certificate(FLEET, serial, role, (number, number), name)
    return certificate.encode() + SIGNER.sign(certificate.to_be_signed(key))


def published(least: int = 1, revoked: tuple[int, ...] = (), fleet: bytes = FLEET) -> bytes:
    bulletin = Bulletin(fleet, 1, least, revoked)
    return bulletin.encode() + SIGNER.sign(bulletin.to_be_signed())


RELAY = Contact(RELAY_KEY, certified(RELAY_KEY, 1, MemberRole.RELAY, 0, "relay"), ("relay.example.org:5790",), True)
OWN = certified(KEY, 2, MemberRole.VEHICLE, 7, "v7")
REPLY = Reply(
    X25519,
    frozenset({MemberRole.OPERATOR}),
    False,
    (),
    SIGNER.public,
    OWN,
    published(),
    (RELAY,),
)


def test_lines_are_read_as_they_were_written() -> None:
    """They are short enough to paste."""
    request = Request("v7", KEY)
    assert parse_request(f"  {request.line()}\r\n") == request
    assert parse_reply(f"{REPLY.line()}\n") == REPLY
    most = REPLY._replace(
        suite=SUITES[16],
        calls=frozenset(MemberRole),
        relays=True,
        addresses=("station.example.org:5790",),
        bulletin=published(revoked=tuple(range(1, MOST_REVOKED + 1))),
        contacts=(RELAY, RELAY, RELAY._replace(addresses=("[2001:db8::1]:5790", "10.13.0.1:5790"), relays=False)),
    )
    assert parse_reply(most.line()) == most
    assert (len(request.line()), len(REPLY.line())) == (73, 507)
    assert len(most.line()) < LONGEST_LINE


@given(st.integers(0, 72), st.characters(codec="ascii"))
def test_altered_request_is_refused(at: int, character: str) -> None:
    """Whatever character of it a chat changed, or where it cut the line."""
    line = Request("v7", KEY).line()
    altered = line[:at] + character + line[at + 1 :]
    for text in (line[:at], altered):
        if text.split() != line.split():
            with pytest.raises(FleetError):
                parse_request(text)


@given(st.integers(0, 506), st.characters(codec="ascii"))
def test_altered_reply_is_refused(at: int, character: str) -> None:
    """By its checksum, before any signature is verified."""
    line = REPLY.line()
    altered = line[:at] + character + line[at + 1 :]
    for text in (line[:at], altered):
        if text.strip() != line:
            with pytest.raises(FleetError, match=r"copy it again|fleet sign"):
                parse_reply(text)


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (Request("V7", KEY), "is not a name"),
        (Request("v7", bytes(32)), "small order"),
        (Request("v7", KEY + b"x"), "changed on its way"),
    ],
)
def test_impossible_request_is_refused(request_: Request, reason: str) -> None:
    """Although its check is right."""
    with pytest.raises(FleetError, match=reason):
        parse_request(request_.line())


@pytest.mark.parametrize(
    ("at", "value", "reason"),
    [(0, 1, "another version"), (1, 9, "does not know"), (2, 1, "does not know"), (3, 2, "does not know")],
)
def test_unknown_field_is_refused(at: int, value: int, reason: str) -> None:
    """A later version may have it."""
    data = bytearray(base64.b64decode(REPLY.line() + "==")[:-4])
    data[at] = value
    line = base64.b64encode(data + sha256(bytes(data))[:4]).decode().rstrip("=")
    with pytest.raises(FleetError, match=reason):
        parse_reply(line)


@pytest.mark.parametrize("contacts", [(RELAY,) * 4, (RELAY._replace(addresses=()),)])
def test_impossible_contacts_are_refused(contacts: tuple[Contact, ...]) -> None:
    """More than a daemon has, or one without an address."""
    with pytest.raises(FleetError, match="does not know"):
        parse_reply(REPLY._replace(contacts=contacts).line())


def test_address_too_long_for_a_line_is_refused() -> None:
    """Its length has one byte."""
    longest = "relay." * 42 + "x:1"
    assert parse_reply(REPLY._replace(addresses=(longest,)).line()).addresses == (longest,)
    with pytest.raises(FleetError, match="at most 255 characters"):
        REPLY._replace(addresses=(f"x{longest}",)).line()


def test_request_in_place_of_a_reply_is_named() -> None:
    """The error says where it belongs."""
    with pytest.raises(FleetError, match="give it to `uavlinkd fleet sign`"):
        parse_reply(Request("v7", KEY).line())


def test_verified_reply_holds_its_contacts() -> None:
    """For the key of the request only."""
    trust = verify_reply(REPLY, KEY)
    assert trust.own is not None
    assert trust.own.certificate.name == "v7"
    assert [held.certificate.name for held in trust.held.values()] == ["relay"]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"authority": b"\1" + bytes(31)}, "valid authority or bulletin"),
        ({"authority": KEY}, "valid authority or bulletin"),
        ({"bulletin": published(fleet=b"abcd")}, "not a bulletin of this fleet"),
        ({"bulletin": published(least=3)}, "revoked certificate, serial 2"),
        ({"bulletin": published(revoked=(2,))}, "revoked certificate, serial 2"),
        ({"bulletin": published(revoked=(1,))}, "contact without a valid certificate"),
        ({"certificate": certified(OTHER_KEY, 2, MemberRole.VEHICLE, 8, "v8")}, "another key, named v8"),
        ({"certificate": bytes(100)}, "does not know"),
        ({"contacts": (RELAY._replace(public_key=OTHER_KEY),)}, "contact without a valid certificate"),
        ({"contacts": (RELAY._replace(addresses=("relay.example.org",)),)}, "address that has no port"),
        ({"addresses": ("0.0.0.0",)}, "address that has no port"),
    ],
)
def test_reply_that_does_not_verify_is_refused(changes: dict[str, object], reason: str) -> None:
    """Each part that an attacker could exchange."""
    with pytest.raises(FleetError, match=reason):
        verify_reply(parse_reply(REPLY._replace(**changes).line()), KEY)  # type: ignore[arg-type]


def test_fingerprint_is_short_and_depends_on_the_key() -> None:
    """Eight characters that are easy to compare."""
    assert len(fingerprint_of(SIGNER.public)) == 8
    assert fingerprint_of(SIGNER.public) != fingerprint_of(KEY)
