"""A sender whose frames are numbered and signed, and a ground station that checks both with pymavlink."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import read
from uavlinkd.mavlink.frames import Frame

SECRET = b"k" * 32


class Autopilot:
    """One system and component that numbers and signs its frames."""

    def __init__(self) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        signing = self._mav.signing
        signing.secret_key, signing.sign_outgoing, signing.timestamp = SECRET, True, 1_000_000
        self.sent: list[Frame] = []
        self._bursts = 0

    def burst(self) -> list[Frame]:
        """The frames of one wake-up during a log download: all classes, events and states."""
        number = self._bursts
        self._bursts += 1
        messages: list[Any] = [mavlink.MAVLink_attitude_message(number, 1, 0, 0, 0, 0, 0)]
        log = [mavlink.MAVLink_log_data_message(1, 90 * number + part, 90, [1] * 90) for part in range(3)]
        messages += log[:2]
        if number % 5 == 0:
            messages.append(mavlink.MAVLink_command_ack_message(400, 0))
        messages.append(mavlink.MAVLink_vfr_hud_message(1, number, 1, 1, 1, 1))
        if number % 50 == 0:
            messages.append(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))
        messages += log[2:]
        made = [self._pack(message) for message in messages]
        self.sent += made
        return made

    def _pack(self, message: Any) -> Frame:
        frame = read(bytes(message.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


class Station(mavutil.mavfile):  # type: ignore[misc]
    """A ground station that reads frames with pymavlink."""

    def __init__(self, raws: Iterable[bytes]) -> None:
        super().__init__(None, "station", source_system=255, notimestamps=True, input=False)
        self.mav.signing.secret_key = SECRET
        self.rejected = 0
        """Frames whose signature has a timestamp that does not grow."""
        for raw in raws:
            for message in self.mav.parse_buffer(raw):
                if message.get_type() == "BAD_DATA":
                    self.rejected += 1
                else:
                    self.post_message(message)
