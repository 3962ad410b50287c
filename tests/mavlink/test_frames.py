"""Frames come out byte for byte, whatever stands around them; what is no frame never does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink import frames as frames_module
from uavlinkd.mavlink.dialect_table import MESSAGES
from uavlinkd.mavlink.frames import (
    MAX_FALSE_STARTS,
    MAX_FRAME_BYTES,
    Frame,
    FrameFault,
    Header,
    SplitCounters,
    StreamSplitter,
    split_datagram,
    split_payload,
)

TEXT = b"\r\nInit ArduCopter V4.6\r\nFree RAM: 21345\r\n"


def packer(*, version: int = 2, signed: bool = False, system: int = 1) -> Any:
    """A pymavlink sender."""
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    sender.seq = 77
    if signed:
        sender.signing.secret_key = b"k" * 32
        sender.signing.sign_outgoing = True
        sender.signing.timestamp = 1_000_000
    sender.wire_is_1 = version == 1
    return sender


def made(message: Any, *, version: int = 2, signed: bool = False, system: int = 1) -> bytes:
    """The message as pymavlink puts it on the wire."""
    return bytes(message.pack(packer(version=version, signed=signed, system=system), force_mavlink1=version == 1))


def heartbeat() -> Any:
    return mavlink.MAVLink_heartbeat_message(2, 3, 81, 5, 4, 3)


def attitude() -> Any:
    return mavlink.MAVLink_attitude_message(1234, 0.1, -0.2, 0.3, 0.01, 0.02, 0.03)


def takeoff(target_system: int = 7, target_component: int = 1) -> Any:
    return mavlink.MAVLink_command_long_message(target_system, target_component, 22, 0, 0, 0, 0, 0, 0, 0, 30)


def parameter() -> Any:
    return mavlink.MAVLink_param_value_message(b"WPNAV_SPEED", 500.0, 9, 1200, 17)


def with_id(msgid: int, payload: bytes = b"unread", crc_extra: int = 99, system: int = 3) -> bytes:
    """A MAVLink 2 frame of any message id."""
    body = bytes([len(payload), 0, 0, 5, system, 1]) + msgid.to_bytes(3, "little") + payload
    return b"\xfd" + body + mcrf4xx(body + bytes([crc_extra])).to_bytes(2, "little")


UNKNOWN = with_id(0xABCDEF)
SHAPES = {
    "v2": made(attitude()),
    "v2 signed": made(attitude(), signed=True),
    "v1": made(attitude(), version=1),
    "v2 heartbeat": made(heartbeat()),
    "v1 heartbeat": made(heartbeat(), version=1),
    "v2 command": made(takeoff()),
    "v1 command": made(takeoff(), version=1),
    "v2 signed parameter": made(parameter(), signed=True),
    "unknown id": UNKNOWN,
}
shapes = pytest.mark.parametrize("raw", SHAPES.values(), ids=SHAPES.keys())
Split = Callable[[bytes, SplitCounters], list[Frame]]


def split_stream(data: bytes, counters: SplitCounters) -> list[Frame]:
    """The stream's splitter, fed byte by byte."""
    splitter = StreamSplitter(counters)
    frames = [frame for i in range(len(data)) for frame in splitter.feed(data[i : i + 1], now=1.0)]
    return frames + splitter.end()


splitters = pytest.mark.parametrize("split", [split_datagram, split_stream, split_payload])
forgiving = pytest.mark.parametrize("split", [split_datagram, split_stream])


def raws(frames: list[Frame]) -> list[bytes]:
    return [frame.raw for frame in frames]


@splitters
@shapes
def test_frame_comes_out_byte_for_byte(raw: bytes, split: Split) -> None:
    """One frame in, the same bytes out, nothing counted against it."""
    counters = SplitCounters()
    assert raws(split(raw, counters)) == [raw]
    assert (counters.frames, counters.garbage_bytes, counters.faults) == (1, 0, {})


@splitters
def test_frames_back_to_back_come_out_in_order(split: Split) -> None:
    """Several frames of all kinds in one datagram come out whole and in order."""
    counters = SplitCounters()
    wanted = list(SHAPES.values()) * 2
    assert raws(split(b"".join(wanted), counters)) == wanted
    assert counters.frames == len(wanted)
    assert counters.unknown == 2
    assert not counters.faults


def test_header_facts_of_a_broadcast() -> None:
    """A message without a target goes to all and carries no command."""
    frame = split_datagram(made(heartbeat(), system=42), SplitCounters())[0]
    assert (frame.header.msgid, frame.header.system, frame.header.component) == (0, 42, 1)
    assert (frame.header.target_system, frame.header.target_component, frame.header.command) == (0, 0, None)
    assert frame.header.is_known
    assert not frame.header.is_mavlink1


@pytest.mark.parametrize("version", [1, 2])
def test_header_facts_of_a_command(version: int) -> None:
    """Target and command number are read where the message's layout has them, in both versions."""
    frame = split_datagram(made(takeoff(7, 9), version=version), SplitCounters())[0]
    assert (frame.header.msgid, frame.header.target_system, frame.header.target_component, frame.header.command) == (
        76,
        7,
        9,
        22,
    )
    assert frame.header.is_mavlink1 == (version == 1)


def test_header_facts_of_a_mission_item() -> None:
    """The command that a mission item carries is read too: it is executed later."""
    item = mavlink.MAVLink_mission_item_int_message(5, 6, 0, 3, 185, 0, 1, 1, 0, 0, 0, 0, 0, 0)
    frame = split_datagram(made(item), SplitCounters())[0]
    assert (frame.header.target_system, frame.header.target_component, frame.header.command) == (5, 6, 185)


def test_command_answer_carries_no_command() -> None:
    """COMMAND_ACK names a command that was asked for; it asks for none, and its target may be cut."""
    frame = split_datagram(made(mavlink.MAVLink_command_ack_message(22, 0)), SplitCounters())[0]
    assert (frame.header.command, frame.header.target_system, frame.header.target_component) == (None, 0, 0)


def test_joystick_has_a_target() -> None:
    """MANUAL_CONTROL calls its target system just "target"."""
    frame = split_datagram(made(mavlink.MAVLink_manual_control_message(9, 1, 2, 3, 4, 5)), SplitCounters())[0]
    assert (frame.header.target_system, frame.header.target_component) == (9, 0)


def test_signature_is_noticed() -> None:
    """A signed frame says so, and its signature is part of its bytes."""
    raw = made(attitude(), signed=True)
    frame = split_datagram(raw, SplitCounters())[0]
    assert frame.raw[2] == 1  # signed
    assert len(raw) == len(made(attitude())) + 13


@pytest.mark.parametrize("kept", range(34))
def test_fields_cut_from_the_payloads_end_are_zero(kept: int) -> None:
    """MAVLink 2 cuts trailing zeros: whatever is cut reads as 0, down to half a command number."""
    payload = bytes(28) + b"\x34\x12" + b"\x07\x09" + b"\x01"
    body = bytes([kept, 0, 0, 5, 1, 1, 76, 0, 0]) + payload[:kept]
    raw = b"\xfd" + body + mcrf4xx(body + bytes([152])).to_bytes(2, "little")
    frame = split_datagram(raw, SplitCounters())[0]
    command = 0x1234 if kept >= 30 else 0x34 if kept == 29 else 0
    assert (frame.header.command, frame.header.target_system, frame.header.target_component) == (
        command,
        7 if kept > 30 else 0,
        9 if kept > 31 else 0,
    )
    assert frame.header.is_known


@pytest.mark.parametrize("more", [0, 1, 200])
def test_payload_longer_than_its_definition_is_unknown(more: int) -> None:
    """A MAVLink 2 frame may be as long as the definition with its extensions; beyond that it passes unread."""
    longest = MESSAGES[76][3]
    raw = with_id(76, bytes(30) + b"\x07\x09\x00" + bytes(longest - 33 + more), crc_extra=152)
    (frame,) = split_datagram(raw, SplitCounters())
    assert frame.raw == raw
    assert frame.header.is_known == (more == 0)
    assert frame.header.target_system == (7 if more == 0 else 0)


@shapes
def test_every_truncation_is_no_frame(raw: bytes) -> None:
    """A frame that lacks its end is not delivered and is counted, for every length."""
    for size in range(1, len(raw)):
        for split in (split_datagram, split_payload, split_stream):
            counters = SplitCounters()
            assert split(raw[:size], counters) == []
            assert counters.faults == {FrameFault.TRUNCATED: 1}
            assert counters.garbage_bytes == size


@shapes
def test_every_flipped_bit_is_noticed(raw: bytes) -> None:
    """No altered frame passes as a known one, at any bit, and never with its CRC altered at all."""
    signed_from = len(raw) - 13 if raw[0] == 0xFD and raw[2] == 1 else len(raw)
    for bit in range(len(raw) * 8):
        altered = bytearray(raw)
        altered[bit // 8] ^= 1 << bit % 8
        frames = split_datagram(bytes(altered), SplitCounters())
        if bit // 8 >= signed_from:
            assert raws(frames) == [bytes(altered)]  # the signature is for the receiver to check
        elif bit // 8 >= signed_from - 2:
            assert frames == []
        else:
            assert not any(frame.header.is_known for frame in frames)


@forgiving
@pytest.mark.parametrize("before", [b"", TEXT, b"\xfd", b"\xfe\x09", b"\xfd\x00\x01" + bytes(5), b"\xfe\xff" + TEXT])
@pytest.mark.parametrize("after", [b"", TEXT, b"\xfd", b"\xfe\xff\x00\x01\x01\x00"])
@pytest.mark.parametrize("raw", [SHAPES["v2"], SHAPES["v1"], SHAPES["v2 signed"]], ids=["v2", "v1", "signed"])
def test_frame_is_found_between_garbage(before: bytes, raw: bytes, after: bytes, split: Split) -> None:
    """Text and false starts before and after a frame cost nothing but themselves, and are all counted."""
    counters = SplitCounters()
    assert raws(split(before + raw + after, counters)) == [raw]
    assert counters.garbage_bytes == len(before) + len(after)
    assert counters.faults.total() == bool(before) + bool(after)


@forgiving
@shapes
def test_broken_frame_does_not_swallow_the_next(raw: bytes, split: Split) -> None:
    """A frame with a bad checksum or with bytes missing is dropped alone; the genuine one behind it is found."""
    checksum_end = len(raw) - 13 if raw[0] == 0xFD and raw[2] == 1 else len(raw)
    follower = SHAPES["v2 command"]
    broken = bytearray(raw)
    broken[checksum_end - 1] ^= 0xFF
    # A signature cut short is not among these: only its receiver could tell that from a whole one.
    for start in (bytes(broken), *(raw[:size] for size in (1, 3, 10, checksum_end // 2, checksum_end - 1))):
        counters = SplitCounters()
        assert raws(split(start + follower + follower, counters)) == [follower, follower]
        assert counters.garbage_bytes == len(start)
        assert counters.faults.total() == 1


def test_run_of_garbage_is_one_fault_of_its_first_bytes_kind() -> None:
    """Boot text counts once however long, whatever looks like a start within it."""
    for garbage, reason in [
        (TEXT * 9 + b"\xfe\xfe\xfd" + TEXT, FrameFault.NOT_MAVLINK),
        (b"\xfd\x09\x02" + TEXT, FrameFault.UNKNOWN_FLAGS),
        (SHAPES["v2"][:-1] + b"\x00" + b"\xfe" + TEXT, FrameFault.BAD_CRC),
        (b"\xfe\xff" + TEXT, FrameFault.TRUNCATED),
    ]:
        counters = SplitCounters()
        assert split_datagram(garbage, counters) == []
        assert counters.faults == {reason: 1}
        assert counters.garbage_bytes == len(garbage)


def test_datagram_of_false_starts_is_given_up() -> None:
    """A search costs a bounded number of checksums in a row; a stream, whose bytes are few, is searched on."""
    start, follower = b"\xfe", SHAPES["v2"]
    for number in (MAX_FALSE_STARTS - 1, MAX_FALSE_STARTS):
        counters = SplitCounters()
        found = raws(split_datagram(follower + start * number + follower, counters))
        assert found == [follower] * (2 if number < MAX_FALSE_STARTS else 1)
        assert counters.faults.total() == 1
        assert raws(split_stream(start * number + follower + bytes(300), SplitCounters())) == [follower]


def test_empty_datagram_is_nothing() -> None:
    """An empty datagram has no frame and no fault."""
    for split in (split_datagram, split_payload, split_stream):
        counters = SplitCounters()
        assert split(b"", counters) == []
        assert counters == SplitCounters()


@splitters
@pytest.mark.parametrize("flags", range(2, 256))
def test_unknown_incompatible_flags_are_refused(flags: int, split: Split) -> None:
    """A MAVLink 2 receiver must refuse flags that it does not know; even the frame's length is then unknown."""
    body = bytes([2, flags, 0, 5, 1, 1, 0, 0, 0, 1, 2])
    raw = b"\xfd" + body + mcrf4xx(body + bytes([50])).to_bytes(2, "little")
    counters = SplitCounters()
    assert split(raw, counters) == []
    assert counters.faults == {FrameFault.UNKNOWN_FLAGS: 1}


@splitters
def test_message_with_another_dialects_definition_passes_unread(split: Split) -> None:
    """A known id whose checksum fits another CRC_EXTRA is passed, but its target and command are not trusted."""
    raw = with_id(76, bytes(28) + b"\x16\x00\x07\x01\x01", crc_extra=153)
    counters = SplitCounters()
    (frame,) = split(raw, counters)
    assert frame.raw == raw
    assert (frame.header.is_known, frame.header.command, frame.header.target_system) == (False, None, 0)
    assert counters.unknown == 1


def test_mavlink1_payload_of_another_length_is_another_definition() -> None:
    """MAVLink 1 cuts nothing, so a payload too short or too long is not read by the known layout."""
    for length in (8, 10):
        body = bytes([length, 5, 1, 1, 0]) + bytes(length)
        raw = b"\xfe" + body + mcrf4xx(body + bytes([50])).to_bytes(2, "little")
        (frame,) = split_datagram(raw, SplitCounters())
        assert not frame.header.is_known


@forgiving
def test_unknown_message_passes_only_where_a_frame_is_expected(split: Split) -> None:
    """After garbage only a frame with a proven checksum ends the search: stray bytes must not swallow one."""
    known = SHAPES["v2"]
    assert raws(split(known + UNKNOWN + known, SplitCounters())) == [known, UNKNOWN, known]
    assert raws(split(TEXT + UNKNOWN + known + UNKNOWN, SplitCounters())) == [known, UNKNOWN]


def test_payload_of_an_envelope_is_not_searched() -> None:
    """Text in an authenticated payload ends it: what a peer sends must be frames."""
    first, hidden = SHAPES["v2"], SHAPES["v2 command"]
    counters = SplitCounters()
    assert raws(split_payload(first + TEXT + hidden, counters)) == [first]
    assert counters.faults == {FrameFault.NOT_MAVLINK: 1}
    assert counters.garbage_bytes == len(TEXT + hidden)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("signed", [False, True])
def test_bad_checksum_in_an_envelope_costs_that_frame_alone(version: int, signed: bool) -> None:
    """Frames around one with a bad checksum are kept, and nothing is looked for inside it."""
    good = SHAPES["v2"]
    carrier = made(mavlink.MAVLink_encapsulated_data_message(1, list((good * 7)[:253])), version=version)
    if signed and version == 2:
        carrier = made(mavlink.MAVLink_encapsulated_data_message(1, list((good * 7)[:253])), signed=True)
    at = len(carrier) - (14 if signed and version == 2 else 1)
    bad = carrier[:at] + bytes([carrier[at] ^ 1]) + carrier[at + 1 :]
    counters = SplitCounters()
    assert raws(split_payload(good + bad + good, counters)) == [good, good]
    assert counters.faults == {FrameFault.BAD_CRC: 1}
    assert counters.garbage_bytes == len(bad)


def test_frames_inside_a_frame_stay_inside() -> None:
    """A file transfer may carry frames in its bytes: they are payload."""
    inner = (SHAPES["v2 heartbeat"] * 20)[:253]
    outer = made(mavlink.MAVLink_encapsulated_data_message(1, list(inner)))
    assert raws(split_datagram(outer + outer, SplitCounters())) == [outer, outer]
    assert raws(split_stream(outer + outer, SplitCounters())) == [outer, outer]


def test_stray_start_delays_a_stream_no_longer_than_the_gap() -> None:
    """A false start does not hold back heartbeats until 280 bytes have come."""
    beat = SHAPES["v2 heartbeat"]
    splitter = StreamSplitter(max_gap_s=0.5)
    assert splitter.feed(b"\xfe\xff" + beat, now=10.0) == []
    assert splitter.pending_bytes == 2 + len(beat)
    assert splitter.feed(b"", now=10.5) == []
    assert raws(splitter.feed(beat, now=11.01)) == [beat, beat]
    assert splitter.pending_bytes == 0
    assert splitter.counters.garbage_bytes == 2


def test_stray_start_delays_a_busy_stream_no_longer_than_it_may_be_held() -> None:
    """Where chunks come too often for a silence, what is held is broken after a time of its own; nothing is lost."""
    beat = SHAPES["v2 heartbeat"]
    splitter = StreamSplitter(max_gap_s=2.0, max_hold_s=2.0)
    assert splitter.feed(b"\xfe\xff" + beat, now=10.0) == []
    came = [(second, raws(splitter.feed(beat, now=10.0 + second))) for second in range(1, 6)]
    assert came == [(1, []), (2, []), (3, [beat] * 4), (4, [beat]), (5, [beat])]
    halves = [splitter.feed(half, now=at) for half, at in ((beat[:9], 20.0), (beat[9:], 21.9))]
    assert list(map(raws, halves)) == [[], [beat]]


def test_what_is_broken_can_be_had_without_more() -> None:
    """Frames behind a stray start need not wait until the sender speaks again: they would be old by then."""
    beat = SHAPES["v2 heartbeat"]
    splitter = StreamSplitter(max_gap_s=0.5)
    assert splitter.give_up(9.0) == []
    assert splitter.feed(b"\xfe\xff" + beat, now=10.0) == []
    assert splitter.give_up(10.5) == []
    assert raws(splitter.give_up(10.51)) == [beat]
    assert splitter.give_up(11.0) == splitter.feed(b"", now=60.0) == []


def test_slow_stream_keeps_its_frame_together() -> None:
    """Pauses up to the limit inside a frame do no harm, as long as the frame takes in total."""
    beat = SHAPES["v2 heartbeat"]
    splitter = StreamSplitter(max_gap_s=0.5)
    frames = [f for i in range(len(beat)) for f in splitter.feed(beat[i : i + 1], now=i * 0.5)]
    assert raws(frames) == [beat]


def test_stream_forgets_at_its_end() -> None:
    """Half a frame before a reconnection does not spoil the first frame after it."""
    splitter = StreamSplitter()
    assert splitter.feed(SHAPES["v2"][:20], now=0.0) == []
    assert splitter.end() == []
    assert splitter.counters.faults == {FrameFault.TRUNCATED: 1}
    assert raws(splitter.feed(UNKNOWN, now=0.0)) == [UNKNOWN]


pieces = st.one_of(
    st.sampled_from(list(SHAPES.values())),
    st.binary(max_size=40),
    st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x05\x00", b"\xfe\xff\x00", TEXT, SHAPES["v2"][:-1]]),
)
mixtures = st.lists(pieces, max_size=8).map(b"".join)


@given(data=mixtures, cuts=st.lists(st.integers(0, 400), max_size=12))
@settings(max_examples=400, deadline=None)
def test_chunks_change_nothing(data: bytes, cuts: list[int]) -> None:
    """A stream gives the frames, counters and rest that it would give as one chunk."""
    whole = StreamSplitter()
    wanted = whole.feed(data, now=0.0)
    cut = StreamSplitter()
    edges = [0, *sorted(c for c in cuts if c < len(data)), len(data)]
    found: list[Frame] = []
    for a, b in pairwise(edges):
        found += cut.feed(data[a:b], now=0.0)
        assert cut.pending_bytes < MAX_FRAME_BYTES
    assert found == wanted
    assert cut.counters == whole.counters
    assert cut.pending_bytes == whole.pending_bytes
    assert cut.end() == whole.end()


@given(data=st.one_of(mixtures, st.binary(max_size=600)))
@settings(max_examples=400, deadline=None)
def test_every_byte_is_accounted_for(data: bytes) -> None:
    """Of any bytes, each is in a frame or counted as garbage; a stream and a datagram agree; nothing raises."""
    for split in (split_datagram, split_payload, split_stream):
        counters = SplitCounters()
        frames = split(data, counters)
        assert sum(len(frame.raw) for frame in frames) + counters.garbage_bytes == len(data)
        assert counters.frames == len(frames)
        assert bool(counters.faults) == bool(counters.garbage_bytes)
        at = 0
        for frame in frames:
            at = data.index(frame.raw, at) + len(frame.raw)
    if data.count(0xFD) + data.count(0xFE) < MAX_FALSE_STARTS:
        assert split_datagram(data, SplitCounters()) == split_stream(data, SplitCounters())


@given(data=mixtures)
@settings(max_examples=200, deadline=None)
def test_payload_gives_no_more_than_a_datagram(data: bytes) -> None:
    """The strict reading finds only frames that the forgiving one finds as well, unless bad bytes hide some."""
    strict = raws(split_payload(data, SplitCounters()))
    counters = SplitCounters()
    forgiving_ = raws(split_datagram(data, counters))
    if not counters.faults:
        assert strict == forgiving_
    assert b"".join(strict[:1]) in data


def entries(log: bytes) -> Iterator[bytes]:
    """The frames of a telemetry log: 8 bytes of time before each; the last may be cut."""
    position = 8
    while position + 8 <= len(log):
        if log[position] == 0xFE:
            size = 8 + log[position + 1]
        else:
            size = 12 + log[position + 1] + (13 if log[position + 2] & 1 else 0)
        yield log[position : position + size]
        position += size + 8


def pymavlink_says(raw: bytes) -> bool:
    """Whether pymavlink takes these bytes for one good frame."""
    receiver = mavlink.MAVLink(None)
    try:
        return receiver.parse_char(raw) is not None
    except mavlink.MAVError:
        return False


# What no parser takes: four camera messages that were recorded with a checksum that fits nothing, and a cut end.
BROKEN = {"arducopter_sitl_flight": 0, "ardusub_dive": 4, "copter_flight_mavlink1": 1}
# What pymavlink refuses and is passed unread: message 142 in another dialect's definition.
FOREIGN = {"arducopter_sitl_flight": 0, "ardusub_dive": 0, "copter_flight_mavlink1": 1314}


@pytest.mark.parametrize("flight", sorted(BROKEN))
def test_recorded_flight_comes_out_byte_for_byte(flight: str, shared_data: Path) -> None:
    """Every frame of a real flight comes out as it went in, by datagram, stream and envelope."""
    logged = list(entries((shared_data / f"{flight}.tlog").read_bytes()))
    counters = SplitCounters()
    good = [raw for raw in logged if raws(split_datagram(raw, counters)) == [raw]]
    assert len(logged) - len(good) == BROKEN[flight]
    assert counters.unknown == FOREIGN[flight]

    stream = StreamSplitter()
    together = b"".join(good)
    found = [f.raw for i in range(0, len(together), 777) for f in stream.feed(together[i : i + 777], now=0.0)]
    assert found == good
    batches = [good[i : i + 9] for i in range(0, len(good), 9)]
    assert [raws(split_payload(b"".join(batch), counters)) for batch in batches] == batches


@pytest.mark.parametrize("flight", sorted(BROKEN))
def test_recorded_flight_is_what_pymavlink_counts(flight: str, shared_data: Path) -> None:
    """A frame is known exactly when pymavlink decodes it; unknown ones are those it calls bad data."""
    logged = list(entries((shared_data / f"{flight}.tlog").read_bytes()))
    sample = logged if len(logged) < 30_000 else [*logged[:2_000], *logged[-2_000:]]
    for raw in sample:
        known = [frame for frame in split_datagram(raw, SplitCounters()) if frame.header.is_known]
        assert bool(known) == pymavlink_says(raw)


@pytest.mark.parametrize("flight", ["arducopter_sitl_flight", "copter_flight_mavlink1"])
def test_recorded_facts_are_what_pymavlink_decodes(flight: str, shared_data: Path) -> None:
    """Sender, target and command of real frames are those that a full decode gives."""
    logged = list(entries((shared_data / f"{flight}.tlog").read_bytes()))[:6_000]
    targets = 0
    for raw in logged:
        for frame in split_datagram(raw, SplitCounters()):
            if not frame.header.is_known:
                continue
            message = mavlink.MAVLink(None).parse_char(raw)
            assert (frame.header.msgid, frame.header.system, frame.header.component) == (
                message.get_msgId(),
                message.get_srcSystem(),
                message.get_srcComponent(),
            )
            wanted = getattr(message, "target" if message.msgname == "MANUAL_CONTROL" else "target_system", 0)
            assert frame.header.target_system == wanted
            assert frame.header.target_component == getattr(message, "target_component", 0)
            targets += bool(wanted)
            if frame.header.command is not None:
                assert frame.header.command == message.command
    assert targets > 5


def test_frames_that_say_the_same_share_a_header() -> None:
    """One object for each sender and message, for each target and command, for each version."""

    def header(raw: bytes) -> Header:
        (frame,) = split_datagram(raw, SplitCounters())
        return frame.header

    assert header(made(attitude())) is header(made(attitude(), signed=True))
    assert header(made(takeoff(7, 9))) is header(made(takeoff(7, 9)))
    others = [
        header(raw)
        for raw in (
            made(attitude()),
            made(attitude(), version=1),
            made(attitude(), system=2),
            made(heartbeat()),
            made(takeoff(7, 9)),
            made(takeoff(7, 8)),
            made(takeoff(6, 9)),
        )
    ]
    assert len(set(map(id, others))) == len(others)


def test_memory_of_headers_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever makes up senders and targets fills no memory, and is understood all the same."""
    monkeypatch.setattr(frames_module, "MAX_REMEMBERED", 8)
    monkeypatch.setattr(frames_module, "MAX_REMEMBERED_TARGETS", 8)
    remembered = frames_module._messages
    remembered.clear()
    for system in range(1, 100):
        (frame,) = split_datagram(made(heartbeat(), system=system), SplitCounters())
        assert frame.header.system == system
        assert len(remembered) <= 8
    remembered.clear()
    for target in range(1, 100):
        (frame,) = split_datagram(made(takeoff(target)), SplitCounters())
        assert (frame.header.target_system, frame.header.command) == (target, 22)
        (message,) = remembered.values()
        assert len(message.targeted) <= 8
