"""Envelopes: sealed once, opened once, and never by anyone else."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.protocol.harness import FRAME, flipped, state_of
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.handshake import Keys
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.suites import X25519
from uavlinkd.protocol.wire import Parameters

PLAIN = Parameters(1, False, 16, 1232)
SECRET = replace(PLAIN, confidential=True)
MODES = [
    *(pytest.param(replace(PLAIN, tag_bytes=tag), id=f"tag{tag}") for tag in wire.TAG_LENGTHS),
    pytest.param(SECRET, id="confidential"),
]


def pair(parameters: Parameters = PLAIN) -> tuple[Session, Session]:
    """Initiator's and responder's session, from second 100 to second 280."""
    transport = Secret(b"\1" * 32), Secret(b"\2" * 32)
    ours, theirs = (Keys(X25519, transport, bytes(range(32)), parameters, remote_index=index) for index in (9, 7))
    return (Session(ours, 7, 100.0, 180.0, is_initiator=True), Session(theirs, 9, 100.0, 180.0, is_initiator=False))


def opened(session: Session, datagram: bytes, now: float = 100.0) -> bytes | DropReason | None:
    """The payload of an envelope as ``Node`` has it opened, or why not. Only a payload changes the session."""
    before = state_of(session)
    try:
        _, counter, header_bytes = wire.parse_envelope_header(datagram)
        payload: bytes | DropReason | None = session.open(datagram, header_bytes, counter, now)
    except Drop as drop:
        payload = drop.reason
    assert (state_of(session) == before) == (not isinstance(payload, bytes))
    return payload


@pytest.mark.parametrize("parameters", MODES)
@pytest.mark.parametrize("counter", [0, 65536], ids=["short", "long"])
def test_any_alteration_is_noticed(parameters: Parameters, counter: int) -> None:
    """A bit turned over in any byte, or another length; the genuine envelope then opens, and its copy does not."""
    initiator, responder = pair(parameters)
    initiator.send_counter = counter
    envelope = initiator.seal(FRAME, 0.0)
    for position in range(1, len(envelope)):
        altered = flipped(envelope, position, position % 8)
        expected = DropReason.BAD_TAG
        if counter and position in (3, 4):  # the long counter became small, or still is not
            expected = DropReason.LONG_COUNTER if int.from_bytes(altered[3:7], "big") < 65536 else expected
        assert opened(responder, altered) is expected
    for other in (*(envelope[:length] for length in range(7 + 8, len(envelope))), envelope + b"\0"):
        assert opened(responder, other) is DropReason.BAD_TAG
    assert opened(responder, envelope) == FRAME
    assert opened(responder, envelope) is None
    assert opened(responder, flipped(envelope, len(envelope) - 1)) is DropReason.BAD_TAG, "a forged copy"


@pytest.mark.parametrize("parameters", MODES)
def test_reflected_envelope_is_noticed(parameters: Parameters) -> None:
    """Each direction has its own key: what a side sealed, it does not open, even under its own index."""
    for sender in pair(parameters):
        sender.remote_index = sender.local_index
        assert opened(sender, sender.seal(FRAME, 0.0)) is DropReason.BAD_TAG


def test_last_counter_is_used_and_no_more() -> None:
    """After `SESSION_ENVELOPE_LIMIT` envelopes keys only open. The counts still fit an echo reply, at either end."""
    initiator, responder = pair()
    initiator.send_counter = c.SESSION_ENVELOPE_LIMIT - 1
    assert initiator.is_usable(100.0)
    assert opened(responder, initiator.seal(FRAME, 0.0)) == FRAME
    assert not initiator.is_usable(100.0)
    with pytest.raises(AssertionError):
        initiator.seal(FRAME, 0.0)
    assert initiator.send_counter == c.SESSION_ENVELOPE_LIMIT
    assert opened(initiator, responder.seal(FRAME, 0.0)) == FRAME
    assert responder.expected == initiator.fresh(1000.0) == 2**32 - 1
    assert wire.parse_control(wire.Echo(True, 1, 1, responder.expected, initiator.fresh(1000.0)).encode())


def test_payload_limit_holds_under_either_header() -> None:
    """The longest payload fits into the agreed envelope even when the counter needs four bytes.

    In confidential mode the tag is 16 bytes, whatever was asked for the HMAC.
    """
    for parameters in (PLAIN, SECRET, replace(SECRET, tag_bytes=8), replace(PLAIN, tag_bytes=8, max_envelope=320)):
        initiator, _ = pair(parameters)
        assert initiator.tag_bytes == (16 if parameters.confidential else parameters.tag_bytes)
        for counter in (0, 2**20):
            initiator.send_counter = counter
            size = len(initiator.seal(bytes(initiator.payload_limit), 0.0))
            assert size == parameters.max_envelope - 2 * (counter == 0)


@given(st.lists(st.tuples(st.integers(0, 30), st.booleans()), max_size=60), st.booleans())
def test_delivered_is_sent_at_most_once(arrivals: list[tuple[int, bool]], confidential: bool) -> None:
    """Whatever order, repetition and damage the channel makes: each payload comes out once at most, unaltered."""
    initiator, responder = pair(replace(PLAIN, confidential=confidential))
    sent = [initiator.seal(bytes((0xFD, number)), 0.0) for number in range(31)]
    seen = set[bytes]()
    for number, damaged in arrivals:
        datagram = flipped(sent[number], len(sent[number]) - 1) if damaged else sent[number]
        payload = opened(responder, datagram)
        if damaged:
            assert payload is DropReason.BAD_TAG
        elif payload is None:
            assert bytes((0xFD, number)) in seen
        else:
            assert payload == bytes((0xFD, number))
            assert payload not in seen
            seen.add(bytes((0xFD, number)))
    assert seen == {bytes((0xFD, number)) for number, damaged in arrivals if not damaged}
    assert responder.received == len(seen)
