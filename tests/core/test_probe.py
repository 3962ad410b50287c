"""The probe record: its layout, and every form that is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.harness import FRAME
from uavlinkd.core import wire
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.probe import (
    ANSWER_BYTES,
    LONGEST_LAG_MS,
    MAX_COUNT,
    QUESTION_BYTES,
    UNKNOWN_LAG,
    Probe,
    parse_probe,
)

U32 = st.integers(0, MAX_COUNT)
TOKEN = st.integers(1, MAX_COUNT)
LAG = st.integers(0, UNKNOWN_LAG)
PROBES = st.builds(Probe, U32, TOKEN, U32, U32, LAG) | st.builds(Probe, TOKEN, U32, U32, U32, LAG)
ASKS = Probe(0x01020304, 0, 5, 6, 7)
ANSWERS = Probe(0, 0x01020304, 5, 6, 7)


def test_question_is_the_documented_record() -> None:
    """Byte by byte, as the specification draws it."""
    encoded = Probe(0x01020304, 0x05060708, 0x090A0B0C, 0x0D0E0F10, 0x1112).encode()

    assert encoded == bytes((3, 0)) + bytes(range(1, 0x13)) + bytes(2)
    assert len(encoded) == QUESTION_BYTES == 22


def test_answer_ends_before_the_zero() -> None:
    """A probe that only answers is two bytes shorter."""
    encoded = Probe(0, 0x05060708, 1, 2).encode()

    assert encoded == bytes.fromhex("0300 00000000 05060708 00000001 00000002 ffff")
    assert len(encoded) == ANSWER_BYTES == 20


def test_answer_is_shorter_than_its_question_under_any_header() -> None:
    """Even with the longer header around it, the answer costs no more than the question under the shorter."""
    difference = wire.LONG_HEADER_BYTES - wire.SHORT_HEADER_BYTES

    assert len(ANSWERS.encode()) + difference <= len(ASKS.encode())


@given(PROBES, st.binary(max_size=40))
def test_probe_round_trip(probe: Probe, frames: bytes) -> None:
    """A probe comes back as it was, with the frames behind it."""
    assert parse_probe(probe.encode(frames)) == (probe, frames)


@given(PROBES, st.integers(1, 1000))
def test_padding_is_not_delivered(probe: Probe, padding: int) -> None:
    """Padding makes an envelope longer, and no more."""
    encoded = probe.encode(padding=padding)

    assert len(encoded) == len(probe.encode()) + padding
    assert parse_probe(encoded) == (probe, b"")


def test_counts_wrap() -> None:
    """Counts above 32 bits keep their lowest 32."""
    assert parse_probe(Probe(1, 0, 2**32 + 5, 2**33 + 6).encode()) == (Probe(1, 0, 5, 6), b"")


def test_longest_lag_is_known() -> None:
    """One less than the value that says that the lag is unknown."""
    assert LONGEST_LAG_MS == UNKNOWN_LAG - 1
    assert parse_probe(ASKS._replace(lag_ms=LONGEST_LAG_MS).encode()) == (ASKS._replace(lag_ms=LONGEST_LAG_MS), b"")


@pytest.mark.parametrize(
    "payload",
    [
        pytest.param(Probe(0, 0, 1, 1).encode(), id="neither question nor answer"),
        pytest.param(ASKS.encode()[:-1], id="question cut short"),
        pytest.param(ASKS.encode()[:-2], id="question without the zero"),
        pytest.param(ANSWERS.encode()[:-1], id="answer cut short"),
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
def test_bad_form_is_refused(payload: bytes) -> None:
    """There is one way to write a probe."""
    assert parse_probe(payload) is None
    with pytest.raises(Drop) as raised:
        wire.parse_control(payload)
    assert raised.value.reason is DropReason.BAD_CONTROL


@pytest.mark.parametrize("probe", [ASKS, ANSWERS, ASKS._replace(answer=9)])
def test_every_truncation_is_refused(probe: Probe) -> None:
    """At any byte."""
    encoded = probe.encode()
    assert all(parse_probe(encoded[:length]) is None for length in range(1, len(encoded)))
