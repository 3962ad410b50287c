"""Bytes for the splitters: frames of every shape, and bytes that are not frames."""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import build, pack
from uavlinkd.mavlink.frames import Frame, SplitCounters, StreamSplitter

TEXT = b"\r\nInit ArduCopter V4.6\r\nFree RAM: 21345\r\n"
UNKNOWN = build(0xABCDEF, b"unread", 3, crc_extra=99)
_ATTITUDE = mavlink.MAVLink_attitude_message(1234, 0.1, -0.2, 0.3, 0.01, 0.02, 0.03)
_HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 3, 81, 5, 4, 3)
_TAKEOFF = mavlink.MAVLink_command_long_message(7, 1, 22, 0, 0, 0, 0, 0, 0, 0, 30)
_PARAMETER = mavlink.MAVLink_param_value_message(b"WPNAV_SPEED", 500.0, 9, 1200, 17)
SHAPES = {
    "v2": pack(_ATTITUDE, seq=77),
    "v2 signed": pack(_ATTITUDE, seq=77, signed=True),
    "v1": pack(_ATTITUDE, seq=77, version=1),
    "v2 heartbeat": pack(_HEARTBEAT, seq=77),
    "v1 heartbeat": pack(_HEARTBEAT, seq=77, version=1),
    "v2 command": pack(_TAKEOFF, seq=77),
    "v1 command": pack(_TAKEOFF, seq=77, version=1),
    "v2 signed parameter": pack(_PARAMETER, seq=77, signed=True),
    "unknown id": UNKNOWN,
}
"""No piece of one and start of another of these fit a CRC_EXTRA together."""

Split = Callable[[bytes, SplitCounters], list[Frame]]


def split_stream(data: bytes, counters: SplitCounters) -> list[Frame]:
    """The stream's splitter, fed byte by byte."""
    splitter = StreamSplitter(counters)
    frames = [frame for i in range(len(data)) for frame in splitter.feed(data[i : i + 1], now=1.0)]
    return frames + splitter.end()


pieces = st.one_of(
    st.sampled_from(list(SHAPES.values())),
    st.binary(max_size=40),
    st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x05\x00", b"\xfe\xff\x00", TEXT, SHAPES["v2"][:-1]]),
)
mixtures = st.lists(pieces, max_size=8).map(b"".join)
