"""Frames and telemetry logs made for tests."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

START_US = 1_700_000_000_000_000


def frames(count: int, system_id: int = 1) -> list[bytes]:
    """Genuine frames of both versions, signed ones among them."""
    codec = mavlink.MAVLink(None, system_id, 1)
    codec.signing.secret_key = bytes(range(32))
    codec.signing.timestamp = 1
    made = []
    for number in range(count):
        message = mavlink.MAVLink_attitude_message(number, 0.1, 0.2, 0.3, 0, 0, number)
        codec.seq, codec.signing.sign_outgoing = number % 256, number % 3 == 2
        made.append(bytes(message.pack(codec, force_mavlink1=number % 3 == 1)))
    return made


def log_of(parts: list[bytes], step_us: int = 10_000) -> bytes:
    """A log of frames."""
    return b"".join((START_US + number * step_us).to_bytes(8) + part for number, part in enumerate(parts))
