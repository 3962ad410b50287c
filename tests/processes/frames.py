"""MAVLink frames that tests of daemons send and receive."""

from __future__ import annotations

from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.samples import pack

GROUND_SYSTEM = 255


def frame(number: int, system: int = 1, component: int = 1) -> bytes:
    return pack(mavlink.MAVLink_named_value_int_message(number, b"number", number), system, component, seq=number)


def heartbeat(
    system: int = 1, component: int = 1, *, seq: int = 0, kind: int = mavlink.MAV_TYPE_QUADROTOR, version: int = 2
) -> bytes:
    """A sign of life of a vehicle, or of what ``kind`` says."""
    return pack(mavlink.MAVLink_heartbeat_message(kind, 3, 0, 0, 3, 3), system, component, seq=seq, version=version)


def ground_heartbeat(seq: int = 0, system: int = GROUND_SYSTEM) -> bytes:
    message = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    return pack(message, system, 190, seq=seq)


def command_long(
    number: int, system: int, target: tuple[int, int] = (1, 1), *, seq: int = 0, **fields: float
) -> bytes:
    """A command; ``fields`` are ``param1`` to ``param7``."""
    seven = [fields.get(f"param{n}", 0.0) for n in range(1, 8)]
    return pack(mavlink.MAVLink_command_long_message(*target, number, 0, *seven), system, 190, seq=seq)


def numbered(number: int, system: int) -> bytes:
    """Telemetry that says its number, of some 40 bytes."""
    position = mavlink.MAVLink_global_position_int_message(number, 473977420, 85455940, 488000, 3000, 0, 0, 0, 0)
    return pack(position, system, seq=number)


SEPARATOR = 2
"""The first filler that `uavlinkd.mavlink.policy.hidden` puts between frames."""


def frames_in(data: bytes | bytearray) -> Iterator[bytes]:
    """The frames in bytes that are whole frames, by their lengths alone, and separator bytes before them."""
    at = 0
    while at < len(data):
        if data[at] == SEPARATOR:
            at += 1
            continue
        assert data[at] in (0xFD, 0xFE), f"no frame starts at byte {at} of {bytes(data).hex(' ')}"
        size = data[at + 1] + (8 if data[at] == 0xFE else 25 if data[at + 2] else 12)
        yield bytes(data[at : at + size])
        at += size
    assert at == len(data), "the last frame is cut"


def name_of(frame: bytes) -> str:
    """The name of a frame's message."""
    number = frame[5] if frame[0] == 0xFE else int.from_bytes(frame[7:10], "little")
    return str(mavlink.mavlink_map[number].msgname)


def sender_of(frame: bytes) -> int:
    return frame[3] if frame[0] == 0xFE else frame[5]
