"""The stream to a client contains only frames that policy passed."""

from __future__ import annotations

import random

import pytest
from fastcrc.crc16 import mcrf4xx

from tests.mavlink.parsers.captured_member import restart_in_mavlink1
from tests.mavlink.policy.smuggling import (
    ATTITUDE,
    COMMAND_LONG,
    HEARTBEAT,
    HOME_POSITION,
    PARAM_REQUEST_READ,
    SET_MODE,
    SETUP_SIGNING,
    hidden_header,
    source,
    split_over,
    v1,
    v2,
    valid_frames,
)
from tests.samples import read
from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy import hidden
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import MAX_STREAMS, DeliveredStream, DeliveredStreams, Source
from uavlinkd.mavlink.policy.gate import Gate, Refusal

ARM = v2(COMMAND_LONG, bytes(28) + (400).to_bytes(2, "little") + b"\x02\x01\x00", 255)
MODE_V1 = v1(SET_MODE, b"\x04\x00\x00\x00\x02\x51", 255)
MISSION_CHECKSUM = 53
LINK_NODE_STATUS = 8
FILE_BYTES = MESSAGES[110][3]  # of FILE_TRANSFER_PROTOCOL


class Client:
    """One client's stream, and the refused frames."""

    def __init__(self, outgoing: Gate | None = None) -> None:
        self.delivered = DeliveredStream(outgoing)
        self.stream = b""
        self.passed: set[int] = set()  # offsets of the frames that were delivered
        self.authors: list[Source | None] = []  # of each byte

    def send(self, raw: bytes | Frame, sender: Source) -> bool:
        """Whether a frame was delivered."""
        frame = raw if isinstance(raw, Frame) else read(raw)
        data = self.delivered.admit(frame, sender, 1.0)
        if data:
            assert data.endswith(frame.raw)
            self.passed.add(len(self.stream) + len(data) - len(frame.raw))
            self.stream += data
            self.authors += [None] * (len(data) - len(frame.raw)) + [sender] * len(frame.raw)
        return bool(data)

    def may_hold(self, at: int, raw: bytes) -> bool:
        """Whether a valid frame may begin there: it was delivered, or each source of its bytes may send it."""
        whole = raw + bytes(13) if raw[0] == 0xFD and raw[2] else raw
        authors = {source for source in self.authors[at : at + len(raw)] if source is not None}
        return at in self.passed or all(source.gate.permits(read(whole)) for source in authors)


def carrying(hidden: bytes, before: int = 0, msgid: int = ATTITUDE, system: int = 1) -> bytes:
    """An allowed frame with these bytes in its payload."""
    payload = bytes(before) + hidden
    return v2(msgid, payload + bytes(max(0, MESSAGES[msgid][2] - len(payload))), system)


@pytest.mark.parametrize("before", range(15))
def test_frame_that_contains_a_forbidden_one_is_refused(before: int) -> None:
    """At any place of the payload: a MAVLink 1 SET_MODE fits an ATTITUDE of legal length."""
    client, member = Client(), source()
    assert not client.send(carrying(MODE_V1, before), member)
    assert member.gate.refused == {(ATTITUDE, Refusal.HIDDEN_FRAME): 1}
    assert client.send(carrying(bytes(14), before), member)


@pytest.mark.parametrize("extra", [None, 0, 181])
def test_hidden_frame_counts_by_every_crc_extra_of_its_number(extra: int | None) -> None:
    """Message 150 has two definitions, and receivers that lack it use 0."""
    client, member = Client(), source()
    assert not client.send(carrying(v1(150, b"abcd", crc_extra=extra)), member)


def test_hidden_frame_that_no_definition_fits_is_delivered() -> None:
    """A checksum by a CRC_EXTRA of no definition is noise, unless unknown messages pass."""
    assert Client().send(carrying(v1(150, b"abcd", crc_extra=99)), source())


def test_every_crc_extra_counts_where_unknown_messages_pass() -> None:
    """A receiver with a private dialect may be the reason for the list's unknown numbers."""
    member = source(allow_in=[54321])
    assert not Client().send(carrying(v1(150, b"abcd", 255, crc_extra=99)), member)


@pytest.mark.parametrize(
    ("opener", "length", "victim", "is_separated"),
    [
        (HOME_POSITION, 28, ARM, True),  # an old autopilot lacks it, and resumes in its signature
        (LINK_NODE_STATUS, 28, ARM, True),  # ArduPilot lacks it
        (ATTITUDE, 28, ARM, False),  # no receiver rejects it
        (ATTITUDE, 29, ARM, True),  # some receivers reject a payload longer than their definition
        (ATTITUDE, 28, MODE_V1, True),  # a receiver of MAVLink 1 only rejects all of MAVLink 2
    ],
)
def test_open_header_of_another_source_swallows_no_urgent_frame(
    opener: int, length: int, victim: bytes, is_separated: bool
) -> None:
    """A parser that resumes in the member's signature leaves it before the operator's command begins."""
    client, member, operator = Client(), source(allow_in=["LINK_NODE_STATUS"]), source("operator", [255])
    opening = v2(opener, bytes(length - 1) + b"\1", signature=bytes(3) + hidden_header(ATTITUDE, 255))
    assert client.send(opening, member)
    assert client.send(victim, operator)
    resumed = len(opening) - 10  # at the hidden header
    assert (len(client.stream) - len(victim) >= resumed + 12 + 255) == is_separated
    assert client.send(v2(ATTITUDE, bytes(28)), member)
    assert client.send(victim, operator)
    assert client.delivered.separators == is_separated


def test_frame_that_the_source_may_send_passes_inside_another() -> None:
    """A vehicle's recorded flight contains its own frames. Commands of a ground station in it do not pass."""
    vehicle = source("vehicle")
    own = v2(ATTITUDE, bytes(range(28)), 1)
    assert Client().send(file_part(own * 3), vehicle)
    assert not Client().send(file_part(own + ARM), vehicle)
    assert not Client().send(file_part(v2(ATTITUDE, bytes(range(28)), 2)), vehicle)
    assert Client().send(file_part(ARM), source("operator", [255]))


def file_part(content: bytes, system: int = 1) -> bytes:
    """A part of a file in transfer."""
    payload = bytes(12) + content
    return v2(110, payload + bytes(FILE_BYTES - len(payload)), system)


def test_setup_signing_never_passes_hidden() -> None:
    """Also from a source that may send everything."""
    everything = Source("local", Policy({}, is_local=True).incoming)
    assert not Client().send(file_part(v2(SETUP_SIGNING, bytes(41) + b"\1")), everything)
    assert Client().send(file_part(ARM), everything)


def test_client_that_may_not_get_a_command_gets_none_hidden() -> None:
    """Outgoing frames have rules too."""
    display = Policy({"allow_out": ["telemetry", "files"], "system_ids": "all", "allow_in": []}).outgoing
    assert not Client(display).send(file_part(ARM), source("operator", [255]))
    assert Client(display).send(file_part(bytes(40)), source("operator", [255]))


def test_rates_do_not_count_hidden_frames() -> None:
    """The check for a hidden frame does not use up a rate."""
    member = source(rate_in={"ATTITUDE": 2})
    heartbeats = v2(HEARTBEAT, bytes(4) + b"\2\x03\0\0\3")
    frames = [carrying(heartbeats) for _ in range(50)]
    client = Client()
    assert all(client.send(frame, member) for frame in frames)


def test_refusal_is_reported_with_its_source() -> None:
    """The report names the sender of the frame, and its message."""
    reported: list[tuple[str, int, Refusal, float]] = []

    def report(name: str, header: Header, refusal: Refusal, now: float) -> None:
        reported.append((name, header.msgid, refusal, now))

    member = Source("drone1", Policy({"role": "swarm-member", "system_ids": [1]}).incoming, report)
    assert DeliveredStream().admit(read(carrying(MODE_V1)), member, 7.0) == b""
    assert reported == [("drone1", ATTITUDE, Refusal.HIDDEN_FRAME, 7.0)]


@pytest.mark.parametrize("seed", range(20))
def test_no_offset_of_a_stream_begins_a_forbidden_frame(seed: int) -> None:
    """Compared with the simplest search: three sources, frames made of pieces of frames, in any order."""
    rng = random.Random(seed)
    client = Client()
    sources = [source("swarm-member", [1]), source("observer", [2]), source("operator", [255])]
    makers = (a_member_frame, an_observer_frame, an_operator_frame)
    delivered = 0
    for _ in range(400):
        which = rng.randrange(3)
        delivered += client.send(makers[which](rng), sources[which])
    assert delivered > 100
    forbidden = [at for at, raw in valid_frames(client.stream) if not client.may_hold(at, raw)]
    assert forbidden == []
    assert sum(len(source.gate.refused) for source in sources) > 0
    assert sources[2].gate.refused == {}, "a member cannot have the operator's frames refused"
    assert client.delivered.separators > 0


PIECES = (MODE_V1, ARM, v1(HEARTBEAT, bytes(9), 1), b"\xfe", b"\xfd", b"\xfe\x02", b"\xfd\x06\0", bytes(4))


def pieces(rng: random.Random, size: int) -> bytes:
    """Bytes made of frames, start bytes and zeros, cut to a size."""
    result = bytearray(rng.randbytes(rng.randrange(3)))
    while len(result) < size:
        result += rng.choice(PIECES)
    return bytes(result[:size])


def a_member_frame(rng: random.Random) -> bytes:
    """Frames that a captured member can send in its role, including one half of a hidden frame."""
    if rng.random() < 0.4:
        return rng.choice(split_over())
    signature = pieces(rng, 13) if rng.random() < 0.3 else b""
    return v2(ATTITUDE, pieces(rng, 27) + b"\1", 1, signature=signature)


def an_observer_frame(rng: random.Random) -> bytes:
    """The same for an observer."""
    return v2(
        PARAM_REQUEST_READ, pieces(rng, 19) + b"\1", 2, signature=pieces(rng, 13) if rng.random() < 0.5 else b""
    )


def an_operator_frame(rng: random.Random) -> bytes:
    """An honest command or heartbeat; or one that a member predicted, and began a hidden frame for."""
    if rng.random() < 0.3:
        return split_over()[1]
    return ARM if rng.random() < 0.5 else v2(HEARTBEAT, bytes((rng.randrange(256), 0, 0, 0, 6, 8, 0, 0, 3)), 255)


def test_source_cannot_make_every_separator_complete_a_frame() -> None:
    """Eight open headers for which each repeated byte value completes one. The last begins a SET_MODE."""
    opening = bytes.fromhex(
        "fd3c0100070101f20000ee140000000000000000000000000000000000000000000000000000fe4b0029fe4700"
        "55fe43010ffe3f0005fe3b0032fe370026fe33001ffe2f0086112200fe0612ff2a0b040000000251"
    )
    client, member, operator = Client(), source(), source("operator", [255])
    assert client.send(opening, member)
    assert client.send(v2(HEARTBEAT, bytes(4) + b"\6\x08\0\0\3", 255), operator)
    assert operator.gate.refused == {}
    assert {at for at, _ in valid_frames(client.stream, any_extra=True)} == client.passed


def test_hidden_frame_swallows_no_urgent_frame_by_its_signature() -> None:
    """Its checksum is complete, and a parser that accepts it waits for 13 bytes more."""
    client, member, operator = Client(), source(), source("operator", [255])
    own = v2(ATTITUDE, b"\1", signature=bytes(13))[:13]
    assert client.send(v2(HOME_POSITION, bytes(59) + b"\1", signature=own), member)
    assert client.send(ARM, operator)
    assert client.stream.endswith(own + bytes((2,)) * 13 + ARM)


def read_as_v1(extra: int) -> bytes:
    """A MAVLink 2 ATTITUDE of system 1 that is a MAVLink 1 frame as well, of message 1, by this CRC_EXTRA."""
    raw = v2(ATTITUDE, bytes(28))
    crc = mcrf4xx(raw[1 : 6 + 28] + bytes((extra,))).to_bytes(2, "little")
    return v2(ATTITUDE, raw[10:34] + crc + bytes(2))


def test_parser_continues_in_mavlink1_at_the_end_of_a_rejected_frame() -> None:
    """A hidden MAVLink 1 frame may begin with 0xFD, the last checksum byte of a frame that the receiver lacks."""
    client, vehicle = Client(), source("vehicle", [2])
    *first, last = (raw for _, raw in restart_in_mavlink1(MISSION_CHECKSUM).frames)
    assert all(client.send(raw, vehicle) for raw in first)
    assert client.send(last, vehicle), "behind separator bytes"
    assert (client.delivered.separators, vehicle.gate.totals.total()) == (1, 0)


def test_frame_may_be_read_as_mavlink1_from_its_own_start() -> None:
    """Only behind a MAVLink 1 frame that ends with this byte: elsewhere no parser reads it this way."""
    twofold = read_as_v1(MESSAGES[1][1])
    client, member = Client(), source()
    assert client.send(twofold, member)
    opening = v2(ATTITUDE, bytes(27) + b"\1", signature=bytes(6) + b"\xfe\0\0\0\0\0\0")  # ends with the next byte
    assert client.send(opening, member)
    for number, sender in enumerate((member, source("operator", [1])), 1):
        assert client.send(twofold, sender), "behind separator bytes"
        assert client.delivered.separators == number
        assert client.send(opening, member)


@pytest.mark.parametrize("seed", range(50))
def test_separator_completes_no_frame(seed: int) -> None:
    """For any number of open frames, and any place where they end."""
    rng = random.Random(seed)
    tail = b"".join(bytes((rng.choice((0xFD, 0xFE)), rng.randrange(256), rng.randrange(2))) for _ in range(85))
    starts = [start for start in hidden.starts_in(tail, 0) if (hidden.end_of_checksum(tail, start) or 999) > 255]
    data = tail + hidden.separator(tail, starts)
    assert len(starts) > 30
    assert not set(data[255:]) & {0xFD, 0xFE}
    for start in starts:
        end = hidden.end_of_checksum(data, start)
        assert end is not None
        assert hidden.reach(data, start, end) <= len(data)
        assert end == hidden.PAST or not hidden.has_checksum(data, start, end, any_extra=True)


def test_client_that_returns_continues_its_stream() -> None:
    """Its parser may have kept the first half of a hidden frame. The client that is away longest is forgotten."""
    streams, member = DeliveredStreams(), source()
    opening, closing = split_over()
    assert streams.of("/dev/ttyACM0").admit(read(opening), member, 1.0) == opening
    for number in range(MAX_STREAMS - 1):
        streams.of(f"127.0.0.1:{number}")
    assert len(streams.of("/dev/ttyACM0").admit(read(closing), member, 2.0)) > len(closing), "behind separator bytes"
    first = streams.of("127.0.0.1:0")
    streams.of("[::1]:14550")
    assert streams.of("127.0.0.1:0") is first
    assert streams.of("127.0.0.1:1") is not streams.of("127.0.0.1:2")
