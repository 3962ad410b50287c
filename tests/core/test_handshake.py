"""The two handshake messages: headers repeated inside, parameters, and the suite that was chosen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import pytest

from tests.core.harness import KEY_A, KEY_B, KEY_C, seeded, state_of
from uavlinkd.core import constants as c
from uavlinkd.core import handshake, noise, wire
from uavlinkd.core.crypto import Secret
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.handshake import Initiated, Keys, Received
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import SUITES, SUITES_BY_NAME, Suite

ALL_SUITES = [pytest.param(suite, id=suite.name) for suite in SUITES.values()]
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


def exchange(
    suite: Suite = SUITES_BY_NAME["x25519"], psk: Secret | None = None, generations: tuple[int, int] = (0, 0)
) -> Exchange:
    """Both messages between alpha (index 7) and bravo (index 9)."""
    initiated = handshake.initiate(KEY_A, settings(suite, psk, KEY_B.public), 7, generations[0], seeded(1))
    received = handshake.receive_initiation(KEY_B, parsed_initiation(initiated.message))
    message, keys = handshake.respond(received, settings(suite, psk, KEY_A.public), 9, generations[1], seeded(2))
    return Exchange(initiated, received, parsed_response(message), keys)


@pytest.mark.parametrize("psk", [None, PSK], ids=["no psk", "psk"])
@pytest.mark.parametrize("suite", ALL_SUITES)
def test_both_sides_hold_the_same_keys(suite: Suite, psk: Secret | None) -> None:
    """Transport keys, transcript hash and parameters agree, and each side knows the other's key and index."""
    one = exchange(suite, psk, (3, 8))

    keys = handshake.receive_response(one.initiated, one.response)

    assert one.received.public_key == KEY_A.public
    assert keys.transport == one.keys.transport
    assert keys.handshake_hash == one.keys.handshake_hash
    assert keys.parameters == one.keys.parameters
    assert (keys.remote_index, one.keys.remote_index) == (9, 7)
    assert keys.parameters.generation == 9


def test_no_psk_is_a_psk_of_zeros() -> None:
    """Where one side has no PSK and the other 32 zero bytes, they understand each other: it is the same."""
    suite = SUITES_BY_NAME["x25519"]
    one = exchange(suite, None)

    message, _ = handshake.respond(one.received, settings(suite, Secret(bytes(32)), KEY_A.public), 9, 0, seeded(2))

    assert handshake.receive_response(one.initiated, parsed_response(message)).remote_index == 9


@pytest.mark.parametrize("offered", [(1, 2), (2, 1)])
def test_the_first_suite_is_offered_always(offered: tuple[int, int]) -> None:
    """What a side offers is the first of its list, whatever else it accepts."""
    suites = tuple(SUITES[number] for number in offered)
    peer = PeerSettings("peer", KEY_B.public, None, Link(suites=suites))

    for _ in range(3):
        assert handshake.initiate(KEY_A, peer, 7, 0, seeded(1)).message[1] == offered[0]


@pytest.mark.parametrize("position", [2, 3])
def test_altered_header_of_an_initiation_is_noticed(position: int) -> None:
    """The header is outside the Noise transcript, so it is repeated inside: another index is refused."""
    one = exchange()
    altered = bytearray(one.initiated.message)
    altered[position] ^= 1

    with pytest.raises(Drop) as caught:
        handshake.receive_initiation(KEY_B, parsed_initiation(bytes(altered)))
    assert caught.value.reason is DropReason.HEADER_MISMATCH


@pytest.mark.parametrize("position", [2, 3, 4, 5])
def test_altered_header_of_a_response_is_noticed(position: int) -> None:
    """Another sender or receiver index in message 2 is refused, and the genuine message still completes."""
    one = exchange()
    before = state_of(one.initiated)
    header = bytearray(one.response.header)
    header[position] ^= 1

    with pytest.raises(Drop) as caught:
        handshake.receive_response(one.initiated, one.response._replace(header=bytes(header)))
    assert caught.value.reason is DropReason.HEADER_MISMATCH
    assert state_of(one.initiated) == before
    assert handshake.receive_response(one.initiated, one.response).transport == one.keys.transport


def test_response_of_another_suite_is_noticed() -> None:
    """A response that claims another suite than the one offered is refused before anything is computed."""
    one = exchange()

    with pytest.raises(Drop) as caught:
        handshake.receive_response(one.initiated, one.response._replace(suite=SUITES_BY_NAME["mlkem768"]))
    assert caught.value.reason is DropReason.HEADER_MISMATCH


@pytest.mark.parametrize("claimed", ALL_SUITES)
def test_altered_suite_does_not_downgrade(claimed: Suite) -> None:
    """An initiation under the name of another suite is not read: the suite is in prologue and protocol name."""
    offered = SUITES_BY_NAME["ffdhe3072"]
    if claimed == offered:
        claimed = SUITES_BY_NAME["x25519"]
    one = exchange(offered)
    noise_message = one.initiated.message[4:]
    size = wire.initiation_bytes(claimed) - 4 - wire.MACS_BYTES
    header = wire.initiation_header(claimed, 7)
    cut = wire.Initiation(claimed, 7, header, noise_message[:size].ljust(size, b"\0"))

    with pytest.raises(Drop) as caught:
        handshake.receive_initiation(KEY_B, cut)
    assert caught.value.reason is DropReason.BAD_HANDSHAKE


@pytest.mark.parametrize(
    ("tag_bytes", "mac_key_bits", "max_envelope"), [(0, 256, 1232), (16, 40, 1232), (16, 256, 9)]
)
def test_parameters_outside_the_protocol_are_refused(tag_bytes: int, mac_key_bits: int, max_envelope: int) -> None:
    """A peer that asks for what the protocol does not have is refused, as initiator and as responder."""
    suite = SUITES_BY_NAME["x25519"]
    bad = {"tag_bytes": tag_bytes, "mac_key_bits": mac_key_bits, "max_envelope": max_envelope}

    liar = handshake.initiate(KEY_A, settings(suite, None, KEY_B.public, **bad), 7, 0, seeded(1))
    with pytest.raises(Drop) as caught:
        handshake.receive_initiation(KEY_B, parsed_initiation(liar.message))
    assert caught.value.reason is DropReason.BAD_PARAMETERS

    one = exchange()
    message, _ = handshake.respond(one.received, settings(suite, None, KEY_A.public, **bad), 9, 0, seeded(2))
    with pytest.raises(Drop) as caught:
        handshake.receive_response(one.initiated, parsed_response(message))
    assert caught.value.reason is DropReason.BAD_PARAMETERS
    assert handshake.receive_response(one.initiated, one.response).transport == one.keys.transport


def test_initiation_for_another_key_is_refused() -> None:
    """Message 1 is read by the holder of the key it was made for, and by no other."""
    one = exchange()

    with pytest.raises(Drop) as caught:
        handshake.receive_initiation(KEY_C, parsed_initiation(one.initiated.message))
    assert caught.value.reason is DropReason.BAD_HANDSHAKE


def test_pattern_follows_the_suite() -> None:
    """Without a group the pattern is IKpsk2, with one IKhfs+psk2."""
    for suite in SUITES.values():
        expected = noise.IK_HFS_PSK2 if suite.has_group else noise.IK_PSK2
        assert handshake.pattern_of(suite) is expected


def test_parameters_are_those_of_the_link() -> None:
    """A side asks for what its configuration says."""
    link = Link(confidential=True, tag_bytes=32, mac_key_bits=512, max_envelope=700)

    assert handshake.parameters_of(link, 5) == wire.Parameters(5, True, 32, 512, 700, c.FEATURE_REFUSALS)
