"""The lines of an enrolment: what a valid one has, and why others are refused."""

from __future__ import annotations

import json
import zlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.authority.certificates import MOST_REVOKED, Bulletin, Certificate, MemberRole, fleet_id_of
from uavlinkd.authority.enrolment import (
    LONGEST_LINE,
    FleetError,
    Reply,
    Request,
    fingerprint_of,
    parse_reply,
    parse_request,
)
from uavlinkd.protocol.crypto import Secret, SigningKey, sha256, x25519_public_key
from uavlinkd.system.base64_text import to_base64

SIGNER = SigningKey(Secret(bytes(32)))
FLEET = fleet_id_of(SIGNER.public)
KEY, RELAY_KEY, OTHER_KEY = (x25519_public_key(bytes([number]) * 32) for number in (1, 2, 3))


def certified(key: bytes, serial: int, role: MemberRole, number: int, name: str) -> str:
    certificate = Certificate(FLEET, serial, role, (number, number), name)
    return to_base64(certificate.encode() + SIGNER.sign(certificate.to_be_signed(key)))


def published(revoked: tuple[int, ...] = ()) -> str:
    bulletin = Bulletin(FLEET, 1, 1, revoked)
    return to_base64(bulletin.encode() + SIGNER.sign(bulletin.to_be_signed()))


RELAY: dict[str, Any] = {
    "public_key": to_base64(RELAY_KEY),
    "certificate": certified(RELAY_KEY, 1, MemberRole.RELAY, 0, "relay"),
    "addresses": ["relay.example.org:5790"],
    "relays": False,
}
FACTS = {
    "authority": to_base64(SIGNER.public),
    "certificate": certified(KEY, 2, MemberRole.VEHICLE, 7, "v7"),
    "bulletin": published(),
}
REPLY = Reply(FACTS, ["operator"], [RELAY], [], "x25519", False)


def test_lines_are_read_as_they_were_written() -> None:
    """They are short enough to paste."""
    request = Request("v7", KEY)
    assert parse_request(f"  {request.line()}\r\n") == request
    assert parse_reply(f"{REPLY.line()}\n") == REPLY
    most = REPLY._replace(
        fleet=FACTS | {"bulletin": published(tuple(range(1, MOST_REVOKED + 1)))},
        calls=["operator", "vehicle"],
        addresses=["station.example.org:5790"],
        contacts=[RELAY, RELAY, RELAY | {"addresses": ["[2001:db8::1]:5790", "wss://relay.example.org:443/uavlink"]}],
        relays=True,
    )
    assert parse_reply(most.line()) == most
    assert len(request.line()) == 73
    assert len(REPLY.line()) < 700
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


@given(st.integers(0, 649), st.characters(codec="ascii"))
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
    "fields",
    [
        [],
        [4, *REPLY],
        [3, *REPLY, 0],
        [3, *REPLY._replace(calls=1)],  # type: ignore[arg-type]
        [3, *REPLY._replace(contacts=[RELAY | {"relays": 1}])],
        [3, *REPLY._replace(contacts=[RELAY | {"port": 1}])],
        [3, *REPLY._replace(contacts=[RELAY | {"certificate": FACTS["bulletin"]}])],
        [3, *REPLY._replace(contacts=[RELAY | {"addresses": 1}])],
        [3, *REPLY._replace(addresses=["\ud800"])],
        [3, *REPLY._replace(fleet=FACTS | {"authority": "AAAA"})],
        [3, *REPLY._replace(fleet=FACTS | {"bulletin": FACTS["certificate"]})],
        [3, *REPLY._replace(fleet=FACTS | {"deny": "v7"})],
        [3, *REPLY._replace(fleet=[])],  # type: ignore[arg-type]
        {"3": 1},
    ],
)
def test_unknown_field_is_refused(fields: object) -> None:
    """A later version may have it. Nothing else gets into a configuration."""
    data = zlib.compress(json.dumps(fields).encode())
    with pytest.raises(FleetError, match="does not know"):
        parse_reply(to_base64(data + sha256(data)[:4]))


def test_request_in_place_of_a_reply_is_named() -> None:
    """The error says where it belongs."""
    with pytest.raises(FleetError, match="give it to `uavlinkd fleet sign`"):
        parse_reply(Request("v7", KEY).line())


def test_fingerprint_is_short_and_depends_on_the_key() -> None:
    """Eight characters that are easy to compare."""
    assert len(fingerprint_of(SIGNER.public)) == 8
    assert fingerprint_of(SIGNER.public) != fingerprint_of(KEY)
