"""Records between a member and its relay: encodings, parsers, encryption, and what a node does with them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.protocol.harness import AT_A, AT_B, ELSEWHERE, Pair, Side, datagrams, of, only, quiet, reasons, unsealed
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.outputs import Output, RecordReceived
from uavlinkd.protocol.relay_records import (
    WAITING,
    Bind,
    Bound,
    Candidates,
    Record,
    binds_of,
    bounds_of,
    handle_of,
    parse_record,
    wrap,
)

KEYS = [bytes([number]) * c.KEY_BYTES for number in range(1, 41)]
BIND = Bind((KEYS[0], KEYS[1]))
BOUND = Bound("203.0.113.7", 5790, ((KEYS[0], 0x1234), (KEYS[1], WAITING)))
LINK = quiet(features=c.FEATURE_RECORDS)
MAPPED = bytes(10) + b"\xff\xff\xcb\x00\x71\x07" + b"\x16\x9e"


# Encodings.


@pytest.mark.parametrize(
    ("record", "encoded"),
    [
        (BIND, b"\x01" + KEYS[0] + KEYS[1]),
        (BOUND, b"\x02" + MAPPED + KEYS[0] + b"\x12\x34" + KEYS[1] + b"\x00\x00"),
        (
            Candidates((("203.0.113.7", 5790), ("2001:db8::1", 1))),
            b"\x03" + MAPPED + bytes.fromhex("20010db8" + 22 * "0" + "01" + "0001"),
        ),
    ],
)
def test_encodings_are_the_documented_ones(record: Record, encoded: bytes) -> None:
    """Byte by byte, as the specification draws them, and back."""
    assert record.encode() == encoded
    assert parse_record(encoded) == record


@given(st.sampled_from((1, 2, 3)), st.integers(0, 1300))
def test_only_whole_entries_within_the_limits_are_valid(kind: int, size: int) -> None:
    """1 to 16 keys in a bind, 1 to 32 entries in a bound record, 1 to 8 candidates."""
    first, entry, most = {
        1: (1, c.KEY_BYTES, c.KEYS_PER_BIND),
        2: (19, 34, c.ENTRIES_PER_BOUND),
        3: (1, 18, c.CANDIDATES),
    }[kind]
    valid = {first + entry * count for count in range(1, most + 1)}
    data = (bytes([kind]) + bytes(size))[: max(1, size)]
    if len(data) in valid:
        assert parse_record(data).encode() == data
    else:
        with pytest.raises(Drop):
            parse_record(data)


def test_data_has_one_form() -> None:
    """Handshake messages, cookie replies and envelopes may be inside data, no relay inside a relay, no bare frame."""
    assert wrap(0x1234, b"\x40abc") == b"\x50\x12\x34\x40abc"
    assert [handle_of(wrap(9, bytes([inner]))) for inner in (1, 2, 3, 0x40, 0x41)] == [9] * 5
    malformed = [b"\x50", wrap(9, b""), wrap(9, b"\x50\x00\x09\x40"), wrap(9, b"\xfd")]
    assert [handle_of(data) for data in malformed] == [0] * 4


def test_few_records_hold_many_keys_and_handles() -> None:
    """All handles of a key are in one record: the receiver replaces them. A key without handles waits."""
    assert [len(bind.keys) for bind in binds_of(KEYS)] == [16, 16, 8]
    assert not list(binds_of([]))
    handles = {key: [1, 2, 3] for key in KEYS[:11]} | {KEYS[11]: []}
    records = list(bounds_of("2001:db8::1", 5790, handles))
    assert [len(record.handles) for record in records] == [30, 4]
    assert records[1].handles[-1] == (KEYS[11], WAITING)
    assert not list(bounds_of("2001:db8::1", 5790, {}))
    largest = Bound("::1", 1, ((KEYS[0], 1),) * c.ENTRIES_PER_BOUND).encode()
    assert 7 + 1 + len(largest) + 16 + 32 <= c.DEFAULT_ENVELOPE_LIMIT, "sealed, with the longest header and tag"


# In a session.


def send(side: Side, record: Record, now: float) -> list[bytes]:
    """The datagrams by which a side sends a record to the other one."""
    return datagrams(side.node.send_record(side.peer, side.peer_at, record, now))


@pytest.fixture
def pair() -> Pair:
    """Both have records, and know that they answer."""
    made = Pair(LINK, LINK).establish()
    assert made.carries(0.0)
    return made


def received(outputs: list[Output]) -> RecordReceived:
    """The record among outputs."""
    return only(of(outputs, RecordReceived))


@pytest.mark.parametrize("confidential", [False, True])
def test_record_crosses_in_both_directions_encrypted(confidential: bool) -> None:
    """With the path that it came by. A listener must not learn the keys of the fleet. It expects no answer."""
    link = replace(LINK, confidential=confidential)
    pair = Pair(link, link).establish()
    assert pair.carries(0.0)
    pair.a.receive(pair.b.envelope(1.0), 1.0)
    datagram = only(send(pair.a, BIND, 1.0))
    assert pair.a.peer.unanswered_since is None
    payload = unsealed(pair.b.session, datagram)
    assert payload is not None
    assert payload[0] == 7
    assert KEYS[0][:8] not in payload + datagram
    there = received(pair.b.receive(datagram, 1.0))
    assert (there.peer, there.path, there.record) == (pair.b.peer, AT_A, BIND)
    back = received(pair.a.receive(only(send(pair.b, BOUND, 1.0)), 1.0))
    assert (back.peer, back.path, back.record) == (pair.a.peer, AT_B, BOUND)


def test_order_grows_with_each_record_session_and_restart(pair: Pair) -> None:
    """A peer that closed its sessions, or forgot them, begins its generations again, and not the order."""
    orders = [received(pair.b.receive(only(send(pair.a, BIND, 1.0)), 1.0)).order for _ in range(2)]
    pair.a.peer.initiator.retry_at = 0.0
    pair.establish(200.0)
    pair.carries(200.0)
    orders.append(received(pair.b.receive(only(send(pair.a, BIND, 200.5)), 200.5)).order)
    for closed in datagrams(pair.a.node.close(201.0)):
        pair.b.receive(closed, 201.0)
    assert pair.b.peer.sessions.current is None
    pair.a.configure_path(210.0)
    pair.establish(210.0)
    pair.carries(210.0)
    orders.append(received(pair.b.receive(only(send(pair.a, BIND, 211.0)), 211.0)).order)
    assert pair.b.session.parameters.generation == 1
    assert orders == sorted(set(orders))


@pytest.mark.parametrize(("offset", "record"), [(1, BIND.encode()), (0, b"\x09")])
def test_record_that_does_not_open_or_parse_has_no_effect(pair: Pair, offset: int, record: bytes) -> None:
    """Although its envelope is authentic: a peer cannot send what it received before as its own."""
    session = pair.a.session
    assert session._record_keys is not None
    sealed = session._record_keys[0].seal(session.send_counter + offset, record, b"")
    assert reasons(pair.b.receive(session.seal(b"\x07" + sealed, 1.0), 1.0)) == [DropReason.BAD_CONTROL]
    for payload in (b"\x07" + bytes(64), b"\x07" + bytes(16), b"\x07"):
        assert reasons(pair.b.receive(session.seal(payload, 1.0), 1.0)) == [DropReason.BAD_CONTROL]


def test_record_needs_both_ends_and_a_path_that_works(pair: Pair) -> None:
    """Without the feature nothing is sent, and what is sent anyway is an invalid control record."""
    assert not pair.a.node.send_record(pair.a.peer, ELSEWHERE, BIND, 1.0)
    assert not send(pair.a, BIND, 500.0)
    assert not send(Pair(LINK, LINK).a, BIND, 0.0)
    pair = Pair(LINK, quiet(features=c.FEATURE_REFUSALS)).establish()
    assert pair.carries(0.0)
    assert not send(pair.a, BIND, 1.0)
    datagram = pair.a.session.seal(b"\x07" + bytes(60), 1.0)
    assert reasons(pair.b.receive(datagram, 1.0)) == [DropReason.BAD_CONTROL]


def test_record_on_a_superseded_session_is_dropped(pair: Pair) -> None:
    """The peer has sent on newer keys for a while."""
    late = pair.a.session.seal(pair.a.session.sealed_record(BIND.encode()), 1.0)
    pair.a.peer.initiator.retry_at = 0.0
    pair.establish(121.0)
    assert pair.carries(121.0)
    assert pair.carries(124.0)
    assert reasons(pair.b.receive(late, 125.0)) == [DropReason.OLD_RECORD]
