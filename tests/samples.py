"""MAVLink frames for tests, as the daemon reads them. ``.raw`` has their bytes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.dialect import IDS, MESSAGES
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload

ID = IDS


def pack(
    message: Any, system: int = 1, component: int = 1, *, seq: int = 0, version: int = 2, signed: bool = False
) -> bytes:
    """The message as pymavlink puts it on the wire."""
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    sender.seq = seq % 256
    if signed:
        sender.signing.secret_key, sender.signing.sign_outgoing, sender.signing.timestamp = b"k" * 32, True, 1_000_000
    return bytes(message.pack(sender, force_mavlink1=version == 1))


def unpacked(raw: bytes) -> Any:
    """The only message in these bytes, as pymavlink reads it."""
    (message,) = mavlink.MAVLink(None).parse_buffer(raw)
    return message


def build(
    msgid: int,
    payload: bytes,
    system: int = 1,
    *,
    version: int = 2,
    crc_extra: int | None = None,
    signature: bytes = b"",
) -> bytes:
    """A frame of any message and content, with the table's CRC_EXTRA by default."""
    if version == 1:
        covered = bytes((len(payload), 7, system, 1, msgid)) + payload
    else:
        covered = bytes((len(payload), bool(signature), 0, 7, system, 1)) + msgid.to_bytes(3, "little") + payload
    extra = (MESSAGES[msgid][1] if msgid in MESSAGES else 7) if crc_extra is None else crc_extra
    checksum = mcrf4xx(covered + bytes((extra,)))
    return bytes((0xFE if version == 1 else 0xFD,)) + covered + checksum.to_bytes(2, "little") + signature


def read(raw: bytes) -> Frame:
    """The only frame in these bytes."""
    (frame,) = split_payload(raw, SplitCounters())
    return frame


def frames_of(raws: Iterable[bytes]) -> list[Frame]:
    """Frames, back to back, as the daemon reads them."""
    return split_payload(b"".join(raws), SplitCounters())


def frame(message: Any, system: int = 1, component: int = 1, *, version: int = 2) -> Frame:
    """The message of this sender."""
    return read(pack(message, system, component, version=version))


def blank(name: str | int, system: int = 1) -> Frame:
    """A frame of a message of the dialect, with nothing but zeros."""
    return read(build(ID[name] if isinstance(name, str) else name, b"\0", system))


def raws(frames: Iterable[Frame]) -> list[bytes]:
    """The bytes of frames."""
    return [raw for raw, _ in frames]


# Messages. ``number`` makes a frame differ from others.


def heartbeat(
    number: int = 0, system: int = 1, component: int = 1, *, kind: int = mavlink.MAV_TYPE_QUADROTOR, version: int = 2
) -> Frame:
    return frame(mavlink.MAVLink_heartbeat_message(kind, 3, 81, number, 4, 3), system, component, version=version)


def attitude(number: int = 1, system: int = 1, *, version: int = 2) -> Frame:
    message = mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1)
    return frame(message, system, version=version)


def position(number: int, system: int = 1, component: int = 1) -> Frame:
    return frame(mavlink.MAVLink_global_position_int_message(number, 1, 2, 3, 4, 5, 6, 7, 8), system, component)


def battery(number: int, which: int, system: int = 1) -> Frame:
    message = mavlink.MAVLink_battery_status_message(which, 1, 1, 2500, [4000] * 10, 120, number, 9, 77)
    return frame(message, system)


def parameter(number: int) -> Frame:
    return frame(mavlink.MAVLink_param_value_message(b"SERVO_FUNCTION", float(number), 9, 999, number))


def file_part(number: int, size: int = 239) -> Frame:
    """A part of a file: an event of this size."""
    payload = [number % 256] * (size - 1) + [1] * (252 - size)
    return frame(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, payload))


def number_value(number: int, system: int = 1, component: int = 1) -> Frame:
    """Some 30 bytes that contain the number."""
    return frame(mavlink.MAVLink_named_value_int_message(number, b"number", number), system, component)


def command(number: int = 1, system: int = 255) -> Frame:
    """The command to arm, with the number as its parameter."""
    return frame(mavlink.MAVLink_command_long_message(1, 1, 400, 0, number, 1, 1, 1, 1, 1, 1), system)


def command_long(
    command: int, system: int = 1, target: tuple[int, int] = (1, 1), *, first: float = 1, version: int = 2
) -> Frame:
    """A command with this first parameter."""
    message = mavlink.MAVLink_command_long_message(*target, command, 0, first, 0, 0, 0, 0, 0, 0)
    return frame(message, system, version=version)


def command_int(command: int, system: int = 1, *, first: float = 1, version: int = 2) -> Frame:
    message = mavlink.MAVLink_command_int_message(1, 1, 0, command, 0, 0, first, 0, 0, 0, 0, 0, 0)
    return frame(message, system, version=version)


def mission_item(command: int, system: int = 1, *, current: int = 0) -> Frame:
    message = mavlink.MAVLink_mission_item_int_message(1, 1, 0, 0, command, current, 1, 1, 0, 0, 0, 0, 0, 0)
    return frame(message, system)


# What several folders send.


def log_data(number: int) -> Frame:
    """A part of a log."""
    return frame(mavlink.MAVLink_log_data_message(1, 90 * number, 90, [number % 256] * 90))


def manual_control(number: int) -> Frame:
    """A joystick's position: the number is in it."""
    return frame(mavlink.MAVLink_manual_control_message(1, number % 1000, number // 1000, 500, 0, 0), 255)


def number_of(control: Frame) -> int:
    """What :func:`manual_control` put into the frame."""
    payload = control.raw[10 : 10 + control.raw[1]].ljust(11, b"\0")
    return int.from_bytes(payload[:2], "little") + 1000 * int.from_bytes(payload[2:4], "little")


def read_by_index(index: int, system: int = 1) -> Frame:
    """A ground station's request for a parameter that was missing in a list."""
    return frame(mavlink.MAVLink_param_request_read_message(system, 1, b"", index), 255)
