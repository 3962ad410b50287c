"""Envelopes: sealed once, opened once, and never by anyone else."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.harness import FRAME, flipped, state_of
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.crypto import AeadKey, Secret, hkdf_expand, hmac_sha256
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.handshake import Keys
from uavlinkd.core.session import Session
from uavlinkd.core.suites import X25519
from uavlinkd.core.wire import Parameters

PLAIN = Parameters(1, False, 16, 256, 1232)
SECRET = replace(PLAIN, confidential=True)
MODES = [
    *(pytest.param(replace(PLAIN, tag_bytes=tag), id=f"tag{tag}") for tag in wire.TAG_LENGTHS),
    *(pytest.param(replace(PLAIN, mac_key_bits=bits), id=f"key{bits}") for bits in wire.MAC_KEY_LENGTHS[1:]),
    pytest.param(SECRET, id="confidential"),
]
TRANSPORT = Secret(b"\1" * 32), Secret(b"\2" * 32)
HASH = bytes(range(32))


def pair(
    parameters: Parameters = PLAIN,
    *,
    transport: tuple[Secret, Secret] = TRANSPORT,
    handshake_hash: bytes = HASH,
) -> tuple[Session, Session]:
    """Initiator's and responder's session, from second 100 to second 280."""
    ours = Keys(transport, handshake_hash, parameters, remote_index=9)
    theirs = Keys(transport, handshake_hash, parameters, remote_index=7)
    return (
        Session(X25519, ours, 7, 100.0, 180.0, is_initiator=True),
        Session(X25519, theirs, 9, 100.0, 180.0, is_initiator=False),
    )


def opened(session: Session, datagram: bytes, now: float = 100.0) -> bytes:
    """The payload of an envelope as ``Node`` has it opened."""
    index, counter, header_bytes = wire.parse_envelope_header(datagram)
    assert index == session.local_index
    payload = session.open(datagram, header_bytes, counter, now)
    assert payload is not None
    return payload


def is_copy(session: Session, datagram: bytes, now: float = 100.0) -> bool:
    """Whether an envelope is an authentic one that the session does not accept; the session is as it was then."""
    before = state_of(session)
    _, counter, header_bytes = wire.parse_envelope_header(datagram)
    payload = session.open(datagram, header_bytes, counter, now)
    assert payload is not None or state_of(session) == before
    return payload is None


def reason_of(session: Session, datagram: bytes, now: float = 100.0) -> DropReason:
    """Why an envelope is refused; the session is as it was then."""
    before = state_of(session)
    try:
        _, counter, header_bytes = wire.parse_envelope_header(datagram)
        session.open(datagram, header_bytes, counter, now)
    except Drop as drop:
        assert state_of(session) == before
        return drop.reason
    raise AssertionError("the envelope was accepted")


@pytest.mark.parametrize("parameters", MODES)
@pytest.mark.parametrize("payload", [b"", b"\xfd", FRAME, FRAME * 40], ids=["empty", "byte", "frame", "many"])
def test_envelope_round_trip_in_both_directions(parameters: Parameters, payload: bytes) -> None:
    """What one side seals the other opens, in any mode; the length is what was announced."""
    initiator, responder = pair(parameters)
    for sender, receiver in ((initiator, responder), (responder, initiator)):
        announced = sender.envelope_bytes(len(payload))
        envelope = sender.seal(payload, 0.0)
        assert len(envelope) == announced == 5 + len(payload) + sender.tag_bytes
        assert opened(receiver, envelope) == payload
        assert receiver.received == receiver.expected == 1


def test_tag_is_a_cut_hmac_under_the_labelled_key() -> None:
    """The envelope is what the specification says, put together here from primitives alone, in each direction."""
    for tag_bytes in wire.TAG_LENGTHS:
        sides = pair(replace(PLAIN, tag_bytes=tag_bytes, mac_key_bits=512))
        for side, transport, direction in (
            (sides[0], b"\1" * 32, b"initiator to responder"),
            (sides[1], b"\2" * 32, b"responder to initiator"),
        ):
            key = hkdf_expand(transport, b"uavlink/2 authenticated " + direction + HASH, 64)
            signed = b"\x40" + side.remote_index.to_bytes(2, "big") + b"\0\0" + FRAME
            assert side.seal(FRAME, 0.0) == signed + hmac_sha256(key, signed)[:tag_bytes]


def test_confidential_envelope_is_sealed_under_the_labelled_key() -> None:
    """In confidential mode the header is associated data and the counter the nonce, under a key of its own label."""
    for side, transport, direction in (
        (pair(SECRET)[0], b"\1" * 32, b"initiator to responder"),
        (pair(SECRET)[1], b"\2" * 32, b"responder to initiator"),
    ):
        side.send_counter = 300
        key = AeadKey(hkdf_expand(transport, b"uavlink/2 confidential " + direction + HASH, 32))
        header = b"\x40" + side.remote_index.to_bytes(2, "big") + b"\x01\x2c"
        assert side.seal(FRAME, 0.0) == header + key.seal(300, FRAME, header)


@pytest.mark.parametrize("parameters", [PLAIN, SECRET])
def test_payload_is_readable_only_without_confidentiality(parameters: Parameters) -> None:
    """By default authentic frames stay readable; in confidential mode nothing of them is."""
    envelope = pair(parameters)[0].seal(FRAME * 3, 0.0)

    assert (FRAME in envelope) != parameters.confidential


@pytest.mark.parametrize("parameters", MODES)
@pytest.mark.parametrize("counter", [0, 65536], ids=["short", "long"])
def test_any_altered_byte_is_noticed(parameters: Parameters, counter: int) -> None:
    """A bit turned over in any byte is refused under a fitting reason; the genuine envelope is then accepted."""
    initiator, responder = pair(parameters)
    initiator.send_counter = counter
    envelope = initiator.seal(FRAME, 0.0)

    for position in range(1, len(envelope)):
        altered = flipped(envelope, position, position % 8)
        expected = DropReason.BAD_TAG
        if counter and position in (3, 4):  # the long counter became small, or still is not
            expected = DropReason.LONG_COUNTER if int.from_bytes(altered[3:7], "big") < 65536 else expected
        assert reason_of(responder, altered) is expected
    assert opened(responder, envelope) == FRAME


@pytest.mark.parametrize("parameters", MODES)
def test_any_truncation_and_extension_is_noticed(parameters: Parameters) -> None:
    """An envelope that lost or won bytes does not verify."""
    initiator, responder = pair(parameters)
    envelope = initiator.seal(FRAME, 0.0)

    for length in range(5 + 8, len(envelope)):
        assert reason_of(responder, envelope[:length]) is DropReason.BAD_TAG
    assert reason_of(responder, envelope + b"\0") is DropReason.BAD_TAG
    assert opened(responder, envelope) == FRAME


@pytest.mark.parametrize("parameters", MODES)
def test_reflected_envelope_is_noticed(parameters: Parameters) -> None:
    """Each direction has its own key: what a side sealed, it does not open, even under its own index."""
    initiator, responder = pair(parameters)
    for sender in (initiator, responder):
        sender.remote_index = sender.local_index
        assert reason_of(sender, sender.seal(FRAME, 0.0)) is DropReason.BAD_TAG


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (PLAIN, SECRET),
        (PLAIN, replace(PLAIN, mac_key_bits=512)),
        (replace(PLAIN, mac_key_bits=1024), replace(PLAIN, mac_key_bits=2048)),
        (PLAIN, replace(PLAIN, tag_bytes=8)),
        (PLAIN, replace(PLAIN, tag_bytes=32)),
    ],
)
def test_ends_in_different_modes_do_not_understand_each_other(ours: Parameters, theirs: Parameters) -> None:
    """Mode, key length and tag length all count: there is no pair of modes that can be mixed up."""
    for sealing, opening in ((ours, theirs), (theirs, ours)):
        assert reason_of(pair(opening)[1], pair(sealing)[0].seal(FRAME, 0.0)) is DropReason.BAD_TAG


def test_other_keys_or_transcript_do_not_open() -> None:
    """Keys are tied to the transport secrets and to every byte of the handshake."""
    for parameters in (PLAIN, SECRET):
        for other in (
            pair(parameters, transport=TRANSPORT[::-1])[1],
            pair(parameters, transport=(Secret(b"\3" * 32), TRANSPORT[1]))[1],
            pair(parameters, handshake_hash=bytes(32))[1],
        ):
            assert reason_of(other, pair(parameters)[0].seal(FRAME, 0.0)) is DropReason.BAD_TAG


def test_each_envelope_opens_once() -> None:
    """A copy opens nothing, at once and later; an envelope that was overtaken opens."""
    initiator, responder = pair()
    first, second, third = (initiator.seal(FRAME, 0.0) for _ in range(3))

    assert opened(responder, third) == FRAME
    assert opened(responder, first) == FRAME
    assert is_copy(responder, first)
    assert is_copy(responder, third)
    assert opened(responder, second) == FRAME
    assert (responder.received, responder.expected) == (3, 3)


def test_envelope_behind_the_window_is_a_copy() -> None:
    """The last one inside the window opens. Whether the one behind it was accepted before is not known any more."""
    initiator, responder = pair()
    old, edge = initiator.seal(FRAME, 0.0), initiator.seal(FRAME, 0.0)
    initiator.send_counter = c.REPLAY_WINDOW
    opened(responder, initiator.seal(FRAME, 0.0))

    assert is_copy(responder, old)
    assert opened(responder, edge) == FRAME


def test_forged_copy_is_a_forgery() -> None:
    """An envelope is a copy only if its tag verifies: a forger cannot make a path look received."""
    initiator, responder = pair()
    envelope = initiator.seal(FRAME, 0.0)
    opened(responder, envelope)

    assert reason_of(responder, flipped(envelope, len(envelope) - 1)) is DropReason.BAD_TAG


def test_forged_high_counter_does_not_move_the_window() -> None:
    """A forgery with the highest counter leaves the window where it is."""
    initiator, responder = pair()
    genuine = initiator.seal(FRAME, 0.0)
    forged = wire.envelope_header(9, c.SESSION_ENVELOPE_LIMIT - 1) + FRAME + bytes(16)

    assert reason_of(responder, forged) is DropReason.BAD_TAG
    assert opened(responder, genuine) == FRAME


@pytest.mark.parametrize(("counter", "kind", "header_bytes"), [(65535, 0x40, 5), (65536, 0x41, 7)])
@pytest.mark.parametrize("parameters", [PLAIN, SECRET])
def test_header_changes_form_with_the_counter(
    parameters: Parameters, counter: int, kind: int, header_bytes: int
) -> None:
    """Counter 65,535 is the last in the short form, 65,536 the first in the long one; both open."""
    initiator, responder = pair(parameters)
    initiator.send_counter = counter
    announced = initiator.envelope_bytes(len(FRAME))
    envelope = initiator.seal(FRAME, 0.0)

    assert envelope[0] == kind
    assert len(envelope) == announced == header_bytes + len(FRAME) + 16
    assert opened(responder, envelope) == FRAME


def test_last_counter_is_used_and_no_more() -> None:
    """A session seals exactly `SESSION_ENVELOPE_LIMIT` envelopes; after that its keys only open."""
    initiator, responder = pair()
    initiator.send_counter = c.SESSION_ENVELOPE_LIMIT - 1
    assert not initiator.is_used_up
    assert initiator.is_usable(100.0)

    assert opened(responder, initiator.seal(FRAME, 0.0)) == FRAME

    assert initiator.send_counter == c.SESSION_ENVELOPE_LIMIT
    assert not initiator.is_usable(100.0)
    with pytest.raises(AssertionError):
        initiator.seal(FRAME, 0.0)
    assert initiator.send_counter == c.SESSION_ENVELOPE_LIMIT
    assert opened(initiator, responder.seal(FRAME, 0.0)) == FRAME


def test_report_of_a_used_up_session_still_fits_its_record() -> None:
    """The counter after the last one fits the fields of an echo reply, at either end."""
    initiator, responder = pair()
    initiator.send_counter = c.SESSION_ENVELOPE_LIMIT - 1
    opened(responder, initiator.seal(FRAME, 0.0))

    assert responder.expected == initiator.fresh(1000.0) == 2**32 - 1
    assert wire.parse_control(wire.Echo(True, 1, 1, responder.expected, initiator.fresh(1000.0)).encode())


def test_keys_end_at_their_time() -> None:
    """Just before the end of the session an envelope opens; at the end it does not, and nothing may be sealed."""
    initiator, responder = pair()
    before, late = initiator.seal(FRAME, 0.0), initiator.seal(FRAME, 0.0)

    assert initiator.is_usable(279.999)
    assert opened(responder, before, 279.999) == FRAME
    assert not initiator.is_usable(280.0)
    assert reason_of(responder, late, 280.0) is DropReason.SESSION_EXPIRED
    assert opened(responder, late, 279.999) == FRAME


def test_payload_limit_holds_under_either_header() -> None:
    """The longest payload fits into the agreed envelope even when the counter needs four bytes."""
    for parameters in (PLAIN, SECRET, replace(PLAIN, tag_bytes=32, max_envelope=c.MIN_ENVELOPE_LIMIT)):
        initiator, _ = pair(parameters)
        for counter in (0, 2**20):
            initiator.send_counter = counter
            assert len(initiator.seal(bytes(initiator.payload_limit), 0.0)) <= parameters.max_envelope


def test_confidential_tag_is_poly1305s() -> None:
    """In confidential mode the tag is 16 bytes, whatever was asked for the HMAC."""
    assert pair(replace(SECRET, tag_bytes=32))[0].tag_bytes == 16
    assert pair(replace(PLAIN, tag_bytes=32))[0].tag_bytes == 32


def test_session_does_not_show_its_keys() -> None:
    """What a session prints is its generation and its index."""
    assert repr(pair()[0]) == "Session(generation=1, local_index=7)"


@given(st.lists(st.tuples(st.integers(0, 30), st.booleans()), max_size=60), st.booleans())
def test_delivered_is_sent_at_most_once(arrivals: list[tuple[int, bool]], confidential: bool) -> None:
    """Whatever order, repetition and damage the channel makes: each payload comes out once at most, unaltered."""
    initiator, responder = pair(replace(PLAIN, confidential=confidential))
    sent = [initiator.seal(bytes((0xFD, number)), 0.0) for number in range(31)]
    seen = set[bytes]()
    for number, damaged in arrivals:
        datagram = flipped(sent[number], len(sent[number]) - 1) if damaged else sent[number]
        try:
            payload = responder.open(datagram, wire.SHORT_HEADER_BYTES, number, 100.0)
        except Drop:
            assert damaged
            continue
        assert not damaged
        if payload is None:
            assert bytes((0xFD, number)) in seen
            continue
        assert payload == bytes((0xFD, number))
        assert payload not in seen
        seen.add(payload)
    assert seen == {bytes((0xFD, number)) for number, damaged in arrivals if not damaged}
