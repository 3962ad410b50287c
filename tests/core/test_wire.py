"""Bytes to fields and back: round trips, truncations, trailing bytes, and any bytes at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.probe import Probe
from uavlinkd.core.refusals import RefusalReport, Refused
from uavlinkd.core.suites import SUITES, SUITES_BY_NAME, Suite
from uavlinkd.core.wire import Parameters

ALL_SUITES = [pytest.param(suite, id=suite.name) for suite in SUITES.values()]
INDEX = st.integers(1, 2**16 - 1)
COUNTER = st.integers(0, c.SESSION_ENVELOPE_LIMIT - 1)
U16 = st.integers(0, 2**16 - 1)
U32 = st.integers(0, 2**32 - 1)
TOKEN = st.integers(1, 2**32 - 1)
FRAMES = st.binary(max_size=30)
SUITE = st.sampled_from(list(SUITES.values()))
PARAMETERS = st.builds(
    Parameters,
    generation=U32,
    confidential=st.booleans(),
    tag_bytes=st.sampled_from(wire.TAG_LENGTHS),
    mac_key_bits=st.sampled_from(wire.MAC_KEY_LENGTHS),
    max_envelope=st.integers(c.MIN_ENVELOPE_LIMIT, 2**16 - 1),
    features=st.integers(0, c.KNOWN_FEATURES),
)
T = TypeVar("T")
CONTROL: st.SearchStrategy[wire.Control] = st.one_of(
    st.builds(wire.Echo, st.just(False), U32, U32, U32, st.just(0)),
    st.builds(wire.Echo, st.just(True), U32, U32, U32, U32),
    st.builds(wire.ProbeAndFrames, st.builds(Probe, TOKEN, U32, U32, U32, U16), FRAMES),
    st.builds(wire.ProbeAndFrames, st.builds(Probe, U32, TOKEN, U32, U32, U16), FRAMES),
    st.just(wire.Close()),
    st.builds(
        RefusalReport,
        st.lists(
            st.builds(Refused, st.integers(0, 2**24 - 1), st.integers(0, 2**16 - 1), st.integers(0, 255), U32),
            min_size=1,
            max_size=c.REFUSALS_PER_REPORT,
        ).map(tuple),
    ),
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


def reason_of(parse: Callable[[bytes], object], data: bytes) -> DropReason:
    """Why a parser refuses these bytes."""
    with pytest.raises(Drop) as caught:
        parse(data)
    return caught.value.reason


def initiation(suite: Suite) -> bytes:
    """An initiation of the right shape and no more than that."""
    header = wire.initiation_header(suite, 0x1234)
    return header + bytes(wire.initiation_bytes(suite) - len(header))


def response(suite: Suite) -> bytes:
    """A response of the right shape and no more than that."""
    header = wire.response_header(suite, 0x1234, 0x5678)
    return header + bytes(wire.response_bytes(suite) - len(header))


COOKIE_REPLY = wire.encode_cookie_reply(0x1234, bytes(range(16)), bytes(range(32)))


@pytest.mark.parametrize(
    ("name", "initiation_bytes", "response_bytes"),
    [
        ("x25519", 147, 103),
        ("ffdhe2048", 419, 375),
        ("ffdhe3072", 547, 503),
        ("ffdhe4096", 675, 631),
        ("ffdhe6144", 931, 887),
        ("ffdhe8192", 1187, 1143),
        ("mlkem768", 1347, 1207),
        ("mlkem1024", 1731, 1687),
    ],
)
def test_message_sizes_of_each_suite(name: str, initiation_bytes: int, response_bytes: int) -> None:
    """An initiation is never shorter than its response, and a cookie reply shorter than either: no amplification."""
    suite = SUITES_BY_NAME[name]

    assert wire.initiation_bytes(suite) == initiation_bytes
    assert wire.response_bytes(suite) == response_bytes
    assert wire.COOKIE_BYTES == 52
    assert wire.COOKIE_BYTES < response_bytes <= initiation_bytes


@given(suite=SUITE, sender=INDEX, data=st.data())
def test_initiation_round_trip(suite: Suite, sender: int, data: st.DataObject) -> None:
    """The fields of an initiation are the bytes that were put in."""
    header = wire.initiation_header(suite, sender)
    size = wire.initiation_bytes(suite) - len(header) - wire.MACS_BYTES
    noise = data.draw(st.binary(min_size=size, max_size=size))

    parsed = wire.parse_initiation(header + noise + bytes(wire.MACS_BYTES))

    assert parsed == (suite, sender, header, noise)
    assert parsed.ephemeral == noise[:32]


@given(suite=SUITE, sender=INDEX, receiver=INDEX, data=st.data())
def test_response_round_trip(suite: Suite, sender: int, receiver: int, data: st.DataObject) -> None:
    """The fields of a response are the bytes that were put in."""
    header = wire.response_header(suite, sender, receiver)
    size = wire.response_bytes(suite) - len(header) - wire.MACS_BYTES
    noise = data.draw(st.binary(min_size=size, max_size=size))

    assert wire.parse_response(header + noise + bytes(wire.MACS_BYTES)) == (suite, sender, receiver, header, noise)


@given(receiver=INDEX, nonce=st.binary(min_size=16, max_size=16), sealed=st.binary(min_size=32, max_size=32))
def test_cookie_reply_round_trip(receiver: int, nonce: bytes, sealed: bytes) -> None:
    """The fields of a cookie reply are the bytes that were put in."""
    assert wire.parse_cookie_reply(wire.encode_cookie_reply(receiver, nonce, sealed)) == (receiver, nonce, sealed)


@pytest.mark.parametrize("suite", ALL_SUITES)
@pytest.mark.parametrize(
    ("parse", "make"), [(wire.parse_initiation, initiation), (wire.parse_response, response)], ids=["1", "2"]
)
def test_handshake_message_of_another_length_is_malformed(
    parse: Callable[[bytes], object], make: Callable[[Suite], bytes], suite: Suite
) -> None:
    """Every truncation and every trailing byte is refused."""
    message = make(suite)

    parse(message)
    for length in range(len(message)):
        assert reason_of(parse, message[:length]) is DropReason.MALFORMED
    for extra in (b"\0", bytes(16), bytes(600)):
        assert reason_of(parse, message + extra) is DropReason.MALFORMED


@pytest.mark.parametrize("suite", ALL_SUITES)
def test_unknown_suite_is_malformed(suite: Suite) -> None:
    """A suite byte that is not in the table makes no message, whatever the length."""
    for number in set(range(256)) - set(SUITES):
        for parse, message in ((wire.parse_initiation, initiation(suite)), (wire.parse_response, response(suite))):
            altered = message[:1] + bytes((number,)) + message[2:]
            assert reason_of(parse, altered) is DropReason.MALFORMED


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
    ids=["initiation", "response sender", "response receiver", "cookie reply", "short envelope", "long envelope"],
)
def test_index_zero_is_malformed(parse: Callable[[bytes], object], message: bytes, at: int) -> None:
    """Index 0 names no session. A message with it in any of its index fields is malformed."""
    parse(message)
    assert reason_of(parse, message[:at] + bytes(2) + message[at + 2 :]) is DropReason.MALFORMED


def test_cookie_reply_of_another_shape_is_malformed() -> None:
    """Every truncation, every trailing byte and every value of the reserved byte but zero is refused."""
    for length in range(len(COOKIE_REPLY)):
        assert reason_of(wire.parse_cookie_reply, COOKIE_REPLY[:length]) is DropReason.MALFORMED
    assert reason_of(wire.parse_cookie_reply, COOKIE_REPLY + b"\0") is DropReason.MALFORMED
    for reserved in range(1, 256):
        altered = COOKIE_REPLY[:1] + bytes((reserved,)) + COOKIE_REPLY[2:]
        assert reason_of(wire.parse_cookie_reply, altered) is DropReason.MALFORMED


@given(receiver=INDEX, counter=COUNTER, rest=st.binary(min_size=8, max_size=64))
def test_envelope_header_round_trip(receiver: int, counter: int, rest: bytes) -> None:
    """Index and counter come back; the header is five bytes for a small counter and seven for others."""
    header = wire.envelope_header(receiver, counter)

    assert len(header) == (5 if counter < 2**16 else 7)
    assert wire.parse_envelope_header(header + rest) == (receiver, counter, len(header))


@pytest.mark.parametrize(
    ("counter", "header"),
    [
        (0, "40 abcd 0000"),
        (65535, "40 abcd ffff"),
        (65536, "41 abcd 00010000"),
        (2**32 - 2, "41 abcd fffffffe"),
    ],
)
def test_envelope_header_at_the_edges(counter: int, header: str) -> None:
    """The header changes its form between counters 65,535 and 65,536, and the last counter fits."""
    assert wire.envelope_header(0xABCD, counter) == bytes.fromhex(header)


@pytest.mark.parametrize("counter", [0, 1, 255, 65535])
def test_small_counter_in_the_long_form_is_refused(counter: int) -> None:
    """There is one way to write a counter, so an envelope has one header."""
    header = b"\x41\xab\xcd" + counter.to_bytes(4, "big")

    assert reason_of(wire.parse_envelope_header, header + bytes(8)) is DropReason.LONG_COUNTER


def test_counter_at_the_limit_is_malformed() -> None:
    """No session seals an envelope under counter 2^32 - 1."""
    assert reason_of(wire.parse_envelope_header, b"\x41\xab\xcd\xff\xff\xff\xff" + bytes(8)) is DropReason.MALFORMED


@pytest.mark.parametrize("counter", [3, 65536])
def test_envelope_shorter_than_header_and_shortest_tag_is_malformed(counter: int) -> None:
    """An envelope has at least its header and eight bytes of tag."""
    header = wire.envelope_header(7, counter)
    whole = header + bytes(8)

    wire.parse_envelope_header(whole)
    for length in range(1, len(whole)):
        assert reason_of(wire.parse_envelope_header, whole[:length]) is DropReason.MALFORMED


@given(PARAMETERS)
def test_parameters_round_trip(parameters: Parameters) -> None:
    """What a side asks for arrives as it was asked."""
    encoded = parameters.encode()

    assert len(encoded) == Parameters.SIZE
    assert wire.parse_parameters(encoded) == parameters


@given(features=st.integers(0, 2**16 - 1), flags=st.integers(0, 255))
def test_unknown_features_and_flags_are_ignored(features: int, flags: int) -> None:
    """A later version may say more; what is known keeps its meaning."""
    encoded = Parameters(7, False, 16, 256, 1232).encode()

    parsed = wire.parse_parameters(encoded[:4] + features.to_bytes(2, "big") + bytes((flags,)) + encoded[7:])

    assert parsed == Parameters(7, bool(flags & 1), 16, 256, 1232, features & c.KNOWN_FEATURES)


def test_other_tag_length_is_refused() -> None:
    """Tags are 8, 12, 16 or 32 bytes; above all not zero."""
    for tag_bytes in set(range(256)) - set(wire.TAG_LENGTHS):
        encoded = Parameters(1, False, tag_bytes, 256, 1232).encode()

        assert reason_of(wire.parse_parameters, encoded) is DropReason.BAD_PARAMETERS


@pytest.mark.parametrize("bits", [0, 1, 8, 128, 255, 257, 384, 1023, 4096, 65535])
def test_other_mac_key_length_is_refused(bits: int) -> None:
    """MAC keys are 256, 512, 1,024 or 2,048 bits."""
    encoded = Parameters(1, False, 16, bits, 1232).encode()

    assert reason_of(wire.parse_parameters, encoded) is DropReason.BAD_PARAMETERS


def test_smallest_envelope_limit() -> None:
    """A limit too small for the largest frame is refused; the least allowed is taken."""
    too_small = Parameters(1, False, 16, 256, c.MIN_ENVELOPE_LIMIT - 1)
    least = Parameters(1, False, 16, 256, c.MIN_ENVELOPE_LIMIT)

    assert reason_of(wire.parse_parameters, too_small.encode()) is DropReason.BAD_PARAMETERS
    assert wire.parse_parameters(least.encode()) == least


@given(st.binary(min_size=Parameters.SIZE, max_size=Parameters.SIZE))
def test_any_parameters_parse_or_drop(data: bytes) -> None:
    """Twelve bytes are parameters within the protocol or a drop."""
    outcome = outcome_of(wire.parse_parameters, data)

    if isinstance(outcome, Parameters):
        assert wire.parse_parameters(outcome.encode()) == outcome
    else:
        assert outcome is DropReason.BAD_PARAMETERS


@given(PARAMETERS, PARAMETERS)
def test_both_ends_agree_on_the_stronger(ours: Parameters, theirs: Parameters) -> None:
    """Neither end gets less than it asked for, and both come to the same."""
    agreed = ours.stronger(theirs)

    assert agreed == theirs.stronger(ours)
    for side in (ours, theirs):
        assert agreed.confidential >= side.confidential
        assert agreed.tag_bytes >= side.tag_bytes
        assert agreed.mac_key_bits >= side.mac_key_bits
        assert agreed.max_envelope <= side.max_envelope
        assert agreed.features & ~side.features == 0
        assert agreed.generation == min(2**32 - 1, 1 + max(ours.generation, theirs.generation))


def changed(parameters: Parameters, field: str, value: int) -> Parameters:
    """The parameters with one field set."""
    changes: dict[str, Any] = {field: value}
    return dataclasses.replace(parameters, **changes)


STRENGTHS = [
    ("confidential", False, True, True),
    ("tag_bytes", 8, 16, 16),
    ("tag_bytes", 12, 32, 32),
    ("mac_key_bits", 256, 2048, 2048),
    ("max_envelope", 400, 1232, 400),
    ("features", 0, 1, 0),
    ("features", 1, 1, 1),
    ("generation", 3, 8, 9),
    ("generation", 2**32 - 1, 0, 2**32 - 1),
]


@pytest.mark.parametrize(("field", "one", "other", "agreed"), STRENGTHS)
def test_stronger_of_each_field(field: str, one: int, other: int, agreed: int) -> None:
    """Each field has its own notion of stronger, independent of the others."""
    base = Parameters(0, False, 8, 256, 1232)
    left, right = (changed(base, field, value) for value in (one, other))

    assert getattr(left.stronger(right), field) == getattr(right.stronger(left), field) == agreed


@given(CONTROL)
def test_control_record_round_trip(record: wire.Control) -> None:
    """A control record comes back as it was, and its first byte is not a frame's."""
    encoded = encoded_of(record)

    assert encoded[0] < wire.FRAMES_FROM
    assert wire.parse_control(encoded) == record


@pytest.mark.parametrize(
    "record",
    [
        wire.Echo(False, 1, 2, 3),
        wire.Echo(True, 1, 2, 3),
        wire.ProbeAndFrames(Probe(1, 0, 3, 4), b""),
        wire.ProbeAndFrames(Probe(0, 2, 3, 4), b""),
    ],
)
def test_control_record_of_another_length_is_refused(record: wire.Control) -> None:
    """Every truncation and trailing bytes are refused."""
    encoded = encoded_of(record)

    for length in range(1, len(encoded)):
        assert reason_of(wire.parse_control, encoded[:length]) is DropReason.BAD_CONTROL
    assert reason_of(wire.parse_control, encoded + b"\0") is DropReason.BAD_CONTROL


def test_close_with_more_behind_it_is_refused() -> None:
    """A close is one byte."""
    assert reason_of(wire.parse_control, b"\x05\0") is DropReason.BAD_CONTROL


PARSERS: list[Callable[[bytes], tuple[object, ...]]] = [
    wire.parse_initiation,
    wire.parse_response,
    wire.parse_cookie_reply,
]
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
    """No bytes make a handshake parser raise anything but a drop."""
    for parse in PARSERS:
        outcome = outcome_of(parse, data)
        assert isinstance(outcome, tuple) or outcome is DropReason.MALFORMED


@given(st.sampled_from([0x40, 0x41]), st.binary(max_size=40))
def test_any_envelope_header_parses_or_drops(kind: int, rest: bytes) -> None:
    """What parses is written back to the same header."""
    datagram = bytes((kind,)) + rest
    outcome = outcome_of(wire.parse_envelope_header, datagram)

    if isinstance(outcome, tuple):
        index, counter, size = outcome
        assert wire.envelope_header(index, counter) == datagram[:size]
    else:
        assert outcome in (DropReason.MALFORMED, DropReason.LONG_COUNTER)


@given(st.binary(min_size=1, max_size=40))
def test_any_control_record_parses_or_drops(payload: bytes) -> None:
    """What parses is written back to the same bytes. Of padding, only its place is known."""
    outcome = outcome_of(wire.parse_control, payload)

    if isinstance(outcome, wire.ProbeAndFrames) and not outcome.frames:
        assert payload.startswith(encoded_of(outcome)[2:], 2)
    elif isinstance(outcome, tuple):
        assert encoded_of(outcome) == payload
    else:
        assert outcome is DropReason.BAD_CONTROL


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


@given(HOSTILE)
def test_any_bytes_claim_an_index(data: bytes) -> None:
    """Reading a claim never raises, and gives 16 bits."""
    assert 0 <= wire.claimed_receiver_index(data) < 2**16
