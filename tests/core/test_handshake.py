"""The two handshake messages: headers repeated inside, parameters, and the suite that was chosen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import pytest

from tests.core.harness import KEY_A, KEY_B, seeded, state_of
from uavlinkd.core import constants as c
from uavlinkd.core import handshake, wire
from uavlinkd.core.crypto import Secret
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.handshake import Initiated, Keys, Received
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import SUITES, SUITES_BY_NAME, Suite

PLAIN = SUITES_BY_NAME["x25519"]
PSK = Secret(bytes(range(32)))


class Exchange(NamedTuple):
    """A handshake in the hands of a test."""

    initiated: Initiated
    received: Received
    response: wire.Response
    keys: Keys


def parsed_initiation(message: bytes) -> wire.Initiation:
    """Message 1 as it arrives."""
    return wire.parse_initiation(message + bytes(wire.MACS_BYTES))


def parsed_response(message: bytes) -> wire.Response:
    """Message 2 as it arrives."""
    return wire.parse_response(message + bytes(wire.MACS_BYTES))


def settings(link_suite: Suite, psk: Secret | None, public: bytes, **changes: Any) -> PeerSettings:
    """A peer with a link of this suite."""
    return PeerSettings("peer", public, psk, replace(Link(suites=(link_suite,)), **changes))


def exchange(suite: Suite = PLAIN, psk: Secret | None = None, generations: tuple[int, int] = (0, 0)) -> Exchange:
    """Both messages between alpha (index 7) and bravo (index 9)."""
    initiated = handshake.initiate(KEY_A, settings(suite, psk, KEY_B.public), 7, generations[0], seeded(1))
    received = handshake.receive_initiation(KEY_B, parsed_initiation(initiated.message))
    message, keys = handshake.respond(received, settings(suite, psk, KEY_A.public), 9, generations[1], seeded(2))
    return Exchange(initiated, received, parsed_response(message), keys)


def refuses(one: Exchange, response: wire.Response) -> DropReason:
    """Why the initiator refuses a response; the genuine one still completes."""
    before = state_of(one.initiated)
    with pytest.raises(Drop) as caught:
        handshake.receive_response(one.initiated, response)
    assert state_of(one.initiated) == before
    assert handshake.receive_response(one.initiated, one.response).transport == one.keys.transport
    return caught.value.reason


def test_no_psk_is_a_psk_of_zeros() -> None:
    """Where one side has no PSK and the other 32 zero bytes, they understand each other: it is the same."""
    one = exchange(PLAIN, None)
    message, _ = handshake.respond(one.received, settings(PLAIN, Secret(bytes(32)), KEY_A.public), 9, 0, seeded(2))
    assert handshake.receive_response(one.initiated, parsed_response(message)).remote_index == 9


def test_a_side_asks_for_what_its_link_says() -> None:
    """It offers the first suite of its list, whatever else it accepts."""
    link = Link(confidential=True, tag_bytes=32, mac_key_bits=512, max_envelope=700)
    assert handshake.parameters_of(link, 5) == wire.Parameters(5, True, 32, 512, 700, c.FEATURE_REFUSALS)
    for offered in ((1, 2), (2, 1)):
        peer = PeerSettings("peer", KEY_B.public, None, Link(suites=tuple(SUITES[number] for number in offered)))
        assert handshake.initiate(KEY_A, peer, 7, 0, seeded(1)).message[1] == offered[0]


@pytest.mark.parametrize("position", [2, 3, 4, 5])
def test_altered_header_is_noticed(position: int) -> None:
    """The header is outside the Noise transcript, so it is repeated inside: another index is refused."""
    one = exchange()
    if position < 4:
        altered = bytearray(one.initiated.message)
        altered[position] ^= 1
        with pytest.raises(Drop) as caught:
            handshake.receive_initiation(KEY_B, parsed_initiation(bytes(altered)))
        assert caught.value.reason is DropReason.HEADER_MISMATCH
    header = bytearray(one.response.header)
    header[position] ^= 1
    assert refuses(one, one.response._replace(header=bytes(header))) is DropReason.HEADER_MISMATCH
    assert refuses(one, one.response._replace(suite=SUITES_BY_NAME["mlkem768"])) is DropReason.HEADER_MISMATCH


@pytest.mark.parametrize(
    ("tag_bytes", "mac_key_bits", "max_envelope"), [(0, 256, 1232), (16, 40, 1232), (16, 256, 9)]
)
def test_parameters_outside_the_protocol_are_refused(tag_bytes: int, mac_key_bits: int, max_envelope: int) -> None:
    """A peer that asks for what the protocol does not have is refused, as initiator and as responder."""
    bad = {"tag_bytes": tag_bytes, "mac_key_bits": mac_key_bits, "max_envelope": max_envelope}
    liar = handshake.initiate(KEY_A, settings(PLAIN, None, KEY_B.public, **bad), 7, 0, seeded(1))
    with pytest.raises(Drop) as caught:
        handshake.receive_initiation(KEY_B, parsed_initiation(liar.message))
    assert caught.value.reason is DropReason.BAD_PARAMETERS
    one = exchange()
    message, _ = handshake.respond(one.received, settings(PLAIN, None, KEY_A.public, **bad), 9, 0, seeded(2))
    assert refuses(one, parsed_response(message)) is DropReason.BAD_PARAMETERS
