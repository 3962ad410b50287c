"""The two handshake messages: the headers that are repeated inside."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from tests.protocol.harness import KEY_A, KEY_B, seeded, state_of
from uavlinkd.protocol import handshake, wire
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.handshake import Initiated, Keys
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES_BY_NAME

PLAIN = SUITES_BY_NAME["x25519"]


class Exchange(NamedTuple):
    """A handshake in the hands of a test."""

    initiated: Initiated
    response: wire.Response
    keys: Keys


def parsed_initiation(message: bytes) -> wire.Initiation:
    """Message 1 as it arrives."""
    return wire.parse_initiation(message + bytes(wire.MACS_BYTES))


def parsed_response(message: bytes) -> wire.Response:
    """Message 2 as it arrives."""
    return wire.parse_response(message + bytes(wire.MACS_BYTES))


def settings(public: bytes) -> PeerSettings:
    """A peer with the smallest suite."""
    return PeerSettings("peer", public, None, Link(suites=(PLAIN,)))


def exchange() -> Exchange:
    """Both messages between alpha (index 7) and bravo (index 9)."""
    initiated = handshake.initiate(KEY_A, settings(KEY_B.public), 7, 0, seeded(1))
    received = handshake.receive_initiation(KEY_B, parsed_initiation(initiated.message))
    message, keys = handshake.respond(received, settings(KEY_A.public), 9, 0, seeded(2))
    return Exchange(initiated, parsed_response(message), keys)


def refuses(one: Exchange, response: wire.Response) -> DropReason:
    """Why the initiator refuses a response; the genuine one still completes."""
    before = state_of(one.initiated)
    with pytest.raises(Drop) as caught:
        handshake.receive_response(one.initiated, response)
    assert state_of(one.initiated) == before
    assert handshake.receive_response(one.initiated, one.response).transport == one.keys.transport
    return caught.value.reason


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
