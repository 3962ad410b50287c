"""Frames that tests of the splitters use, and bytes that are not frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fastcrc.crc16 import mcrf4xx
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.frames import Frame, SplitCounters
from uavlinkd.mavlink.stream_splitter import StreamSplitter

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


Split = Callable[[bytes, SplitCounters], list[Frame]]


def split_stream(data: bytes, counters: SplitCounters) -> list[Frame]:
    """The stream's splitter, fed byte by byte."""
    splitter = StreamSplitter(counters)
    frames = [frame for i in range(len(data)) for frame in splitter.feed(data[i : i + 1], now=1.0)]
    return frames + splitter.end()


def raws(frames: list[Frame]) -> list[bytes]:
    return [frame.raw for frame in frames]


pieces = st.one_of(
    st.sampled_from(list(SHAPES.values())),
    st.binary(max_size=40),
    st.sampled_from([b"\xfd", b"\xfe", b"\xfd\x05\x00", b"\xfe\xff\x00", TEXT, SHAPES["v2"][:-1]]),
)


mixtures = st.lists(pieces, max_size=8).map(b"".join)
