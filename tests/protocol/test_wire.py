"""Bytes to fields and back: round trips, other lengths, and any bytes at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.protocol.harness import FRAME
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.suites import SUITES, Suite
from uavlinkd.protocol.wire import (
    ANSWER_BYTES,
    QUESTION_BYTES,
    Parameters,
    Probe,
    ProblemReport,
    RefusalReport,
    Refused,
)

INDEX = st.integers(1, 2**16 - 1)
U16 = st.integers(0, 2**16 - 1)
U32 = st.integers(0, 2**32 - 1)
TOKEN = st.integers(1, 2**32 - 1)
PARAMETERS = st.builds(
    Parameters,
    generation=U32,
    confidential=st.booleans(),
    tag_bytes=st.sampled_from(wire.TAG_LENGTHS),
    max_envelope=st.integers(c.MIN_ENVELOPE_LIMIT, 2**16 - 1),
    features=st.integers(0, c.KNOWN_FEATURES),
)
T = TypeVar("T")
PROBES = st.builds(Probe, U32, TOKEN, U32, U32) | st.builds(Probe, TOKEN, U32, U32, U32)
REFUSED = st.builds(Refused, st.integers(0, 2**24 - 1), U16, st.integers(0, 255), U32)
CONTROL: st.SearchStrategy[wire.Control] = st.one_of(
    st.builds(wire.Echo, st.just(False), U32, U32, U32, st.just(0)),
    st.builds(wire.Echo, st.just(True), U32, U32, U32, U32),
    st.builds(wire.ProbeAndFrames, PROBES, st.binary(max_size=30)),
    st.just(wire.Close()),
    st.builds(RefusalReport, st.lists(REFUSED, min_size=1, max_size=c.REFUSALS_PER_REPORT).map(tuple[Refused, ...])),
    st.builds(ProblemReport, st.sets(st.integers(0, 255), max_size=8).map(lambda codes: tuple(sorted(codes)))),
)


def encoded_of(record: wire.Control) -> bytes:
    """The payload that holds a control record."""
    return record.probe.encode(record.frames) if isinstance(record, wire.ProbeAndFrames) else record.encode()


def outcome_of(parse: Callable[[bytes], T], data: bytes) -> T | DropReason:
    """What a parser makes of these bytes: a value or a reason, and no other exception."""
    try:
        return parse(data)
    except Drop as drop:
        return drop.reason


def initiation(suite: Suite) -> bytes:
    """An initiation of the right shape and no more than that."""
    header = wire.initiation_header(suite, 0x1234)
    return header + bytes(wire.initiation_bytes(suite) - len(header))


def response(suite: Suite) -> bytes:
    """A response of the right shape and no more than that."""
    header = wire.response_header(suite, 0x1234, 0x5678)
    return header + bytes(wire.response_bytes(suite) - len(header))


COOKIE_REPLY = wire.encode_cookie_reply(0x1234, bytes(range(16)), bytes(range(32)))


# Handshake messages.


@pytest.mark.parametrize(
    ("parse", "message"),
    [
        *((wire.parse_initiation, initiation(suite)) for suite in SUITES.values()),
        *((wire.parse_response, response(suite)) for suite in SUITES.values()),
        (wire.parse_cookie_reply, COOKIE_REPLY),
    ],
)
def test_handshake_message_of_another_form_is_malformed(parse: Callable[[bytes], object], message: bytes) -> None:
    """Every truncation, every trailing byte, and every second byte that is not a suite, or not a cookie's zero."""
    parse(message)
    altered = [message[:length] for length in range(len(message))]
    altered += [message + extra for extra in (b"\0", bytes(16), bytes(600))]
    known = {0} if parse is wire.parse_cookie_reply else set(SUITES)
    altered += [message[:1] + bytes((number,)) + message[2:] for number in set(range(256)) - known]
    assert {outcome_of(parse, data) for data in altered} == {DropReason.MALFORMED}


@pytest.mark.parametrize(
    ("parse", "message", "at"),
    [
        (wire.parse_initiation, initiation(SUITES[0]), 2),
        (wire.parse_response, response(SUITES[0]), 2),
        (wire.parse_response, response(SUITES[0]), 4),
        (wire.parse_cookie_reply, COOKIE_REPLY, 2),
        (wire.parse_envelope_header, wire.envelope_header(0x1234, 5) + bytes(8), 1),
        (wire.parse_envelope_header, wire.envelope_header(0x1234, 2**20) + bytes(8), 1),
    ],
)
def test_index_zero_is_malformed(parse: Callable[[bytes], object], message: bytes, at: int) -> None:
    """Index 0 names no session. A message with it in any of its index fields is malformed."""
    parse(message)
    assert outcome_of(parse, message[:at] + bytes(2) + message[at + 2 :]) is DropReason.MALFORMED


# Envelopes.


@given(INDEX, st.integers(0, c.SESSION_ENVELOPE_LIMIT - 1), st.binary(min_size=8, max_size=64))
@example(0xABCD, 65535, bytes(8))
@example(0xABCD, 65536, bytes(8))
@example(0xABCD, 2**32 - 2, bytes(8))
def test_envelope_header_round_trip(receiver: int, counter: int, rest: bytes) -> None:
    """There is one header for a counter: five bytes for a small one, seven for others. The shortest tag must fit."""
    header = wire.envelope_header(receiver, counter)
    is_short = counter < 2**16
    assert header == (0x40 if is_short else 0x41).to_bytes(1) + receiver.to_bytes(2) + counter.to_bytes(
        2 if is_short else 4
    )
    assert wire.parse_envelope_header(header + rest) == (receiver, counter, len(header))
    for length in range(1, len(header) + 8):
        assert outcome_of(wire.parse_envelope_header, (header + rest)[:length]) is DropReason.MALFORMED


@pytest.mark.parametrize("counter", [0, 1, 255, 65535, 2**32 - 1])
def test_counter_that_has_no_long_form(counter: int) -> None:
    """A small one is written in two bytes. No session seals an envelope under counter 2^32 - 1."""
    expected = DropReason.LONG_COUNTER if counter < 2**16 else DropReason.MALFORMED
    assert outcome_of(wire.parse_envelope_header, b"\x41\xab\xcd" + counter.to_bytes(4) + bytes(8)) is expected


# Parameters.


@given(PARAMETERS, st.integers(0, 2**12 - 1), st.integers(0, 127))
def test_parameters_round_trip(parameters: Parameters, features: int, flags: int) -> None:
    """What a side asks for arrives as it was asked. Unknown features and flags are ignored."""
    encoded = parameters.encode()
    assert len(encoded) == Parameters.SIZE
    assert wire.parse_parameters(encoded) == parameters
    features = parameters.features | features << 4
    later = encoded[:4] + features.to_bytes(2) + bytes((encoded[6] | flags << 1,)) + encoded[7:]
    assert wire.parse_parameters(later) == parameters


def changed(parameters: Parameters, field: str, value: int) -> Parameters:
    """The parameters with one field set."""
    changes: dict[str, Any] = {field: value}
    return dataclasses.replace(parameters, **changes)


@pytest.mark.parametrize(
    ("field", "invalid"),
    [("tag_bytes", set(range(256)) - set(wire.TAG_LENGTHS)), ("max_envelope", {0, c.MIN_ENVELOPE_LIMIT - 1})],
)
def test_parameters_outside_the_protocol_are_refused(field: str, invalid: set[int]) -> None:
    """Tags are 8, 12 or 16 bytes, and the largest frame fits an envelope."""
    least = Parameters(1, False, 8, c.MIN_ENVELOPE_LIMIT)
    assert wire.parse_parameters(least.encode()) == least
    refused = {outcome_of(wire.parse_parameters, changed(least, field, value).encode()) for value in invalid}
    assert refused == {DropReason.BAD_PARAMETERS}


@pytest.mark.parametrize("bits", [0, 1, 128, 255, 257, 512, 1024, 2048, 65535])
def test_an_hmac_key_of_another_length_is_refused(bits: int) -> None:
    """Earlier versions could ask for a longer key. Its field is at offset 8."""
    encoded = Parameters(1, False, 8, c.MIN_ENVELOPE_LIMIT).encode()
    assert int.from_bytes(encoded[8:10], "big") == 256
    asked = encoded[:8] + bits.to_bytes(2, "big") + encoded[10:]
    assert outcome_of(wire.parse_parameters, asked) is DropReason.BAD_PARAMETERS


@given(PARAMETERS, PARAMETERS)
def test_both_ends_agree_on_the_stronger(ours: Parameters, theirs: Parameters) -> None:
    """Each field by itself; both ends come to the same."""
    assert ours.stronger(theirs) == theirs.stronger(ours)
    assert ours.stronger(theirs) == Parameters(
        min(2**32 - 1, 1 + max(ours.generation, theirs.generation)),
        ours.confidential or theirs.confidential,
        max(ours.tag_bytes, theirs.tag_bytes),
        min(ours.max_envelope, theirs.max_envelope),
        ours.features & theirs.features,
    )


# Control records.


@given(CONTROL)
def test_control_record_round_trip(record: wire.Control) -> None:
    """A control record comes back as it was, and its first byte is not a frame's. Cut short, it is invalid."""
    encoded = encoded_of(record)
    assert encoded[0] < wire.FRAMES_FROM
    assert wire.parse_control(encoded) == record
    if isinstance(record, wire.Echo | wire.Close) or (isinstance(record, wire.ProbeAndFrames) and not record.frames):
        altered = [encoded[:length] for length in range(1, len(encoded))] + [encoded + b"\0"]
        assert {outcome_of(wire.parse_control, data) for data in altered} == {DropReason.BAD_CONTROL}


ASKS = Probe(0x01020304, 0, 5, 6)
ANSWERS = Probe(0, 0x01020304, 5, 6)


def test_probe_is_the_documented_record() -> None:
    """Byte by byte. An answer ends before the zero, so it is no longer than its question under any header."""
    encoded = Probe(0x01020304, 0x05060708, 0x090A0B0C, 0x0D0E0F10).encode()
    assert encoded == bytes((3, 0)) + bytes(range(1, 0x11)) + b"\xff\xff" + bytes(2)
    answer = Probe(0, 0x05060708, 1, 2**33 + 2).encode()
    assert answer == bytes.fromhex("0300 00000000 05060708 00000001 00000002 ffff")
    assert (len(encoded), len(answer)) == (QUESTION_BYTES, ANSWER_BYTES) == (22, 20)
    assert len(answer) + wire.LONG_HEADER_BYTES - wire.SHORT_HEADER_BYTES <= len(encoded)


@pytest.mark.parametrize(
    "payload",
    [
        pytest.param(ANSWERS.encode()[:-1], id="too short"),
        pytest.param(Probe(0, 0, 1, 1).encode(), id="neither question nor answer"),
        pytest.param(ASKS.encode() + FRAME, id="frames without a flag"),
        pytest.param(ANSWERS.encode() + bytes(2), id="answer with the zero"),
        pytest.param(bytes((3, 1)) + ASKS.encode()[2:], id="flag without frames"),
        pytest.param(bytes((3, 2)) + ASKS.encode()[2:], id="flag without padding"),
        pytest.param(bytes((3, 3)) + ASKS.encode()[2:] + FRAME, id="both flags"),
        pytest.param(bytes((3, 4)) + ASKS.encode()[2:], id="unknown flag"),
        pytest.param(ASKS.encode()[:-2] + b"\0\1", id="zero is not zero"),
        pytest.param(ASKS.encode()[:-2] + b"\1\0", id="zero is not zero either"),
    ],
)
def test_other_forms_of_a_probe_are_refused(payload: bytes) -> None:
    """There is one way to write a probe."""
    assert outcome_of(wire.parse_control, payload) is DropReason.BAD_CONTROL


# Any bytes.

FIRST_BYTES = st.sampled_from([1, 2, 3, 0x40, 0x41, 0xFD, 0, 255])
SIZES = st.sampled_from([f(s) for s in SUITES.values() for f in (wire.initiation_bytes, wire.response_bytes)])
HOSTILE = st.one_of(
    st.binary(max_size=80),
    st.tuples(FIRST_BYTES, st.binary(max_size=80)).map(lambda parts: bytes(parts[:1]) + parts[1]),
    st.tuples(FIRST_BYTES, st.sampled_from(sorted(SUITES)), SIZES).map(
        lambda parts: bytes(parts[:2]) + bytes(parts[2] - 2)
    ),
)


@given(HOSTILE)
def test_any_bytes_parse_or_drop(data: bytes) -> None:
    """No bytes make a handshake parser raise anything but a drop, nor a claim of an index anything but 16 bits."""
    parsers: list[Callable[[bytes], tuple[object, ...]]] = [wire.parse_initiation, wire.parse_response]
    for parse in (*parsers, wire.parse_cookie_reply):
        outcome = outcome_of(parse, data)
        assert isinstance(outcome, tuple) or outcome is DropReason.MALFORMED
    assert 0 <= wire.claimed_receiver_index(data) < 2**16


@pytest.mark.parametrize(
    ("datagram", "index"),
    [
        (wire.envelope_header(0x1234, 5) + bytes(8), 0x1234),
        (wire.envelope_header(0x1234, 2**20) + bytes(8), 0x1234),
        (response(SUITES[0]), 0x5678),
        (COOKIE_REPLY, 0x1234),
        (initiation(SUITES[0]), 0),
        (b"\x40\x12\x34\0\0\0", 0),
        (b"\xfd" + bytes(20), 0),
        (b"", 0),
    ],
)
def test_claimed_receiver_index(datagram: bytes, index: int) -> None:
    """Of every message that has one, the receiver index is read where it stands; of all else it is 0."""
    assert wire.claimed_receiver_index(datagram) == index
