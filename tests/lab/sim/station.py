"""A ground station without I/O, for tests: messages to an autopilot, its answers decoded."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.autopilot import Autopilot


class Station:
    """Speaks to one autopilot as one system and component, on a clock that it moves itself."""

    def __init__(self, autopilot: Autopilot, system_id: int = 255, component_id: int = 190, now: float = 0.0) -> None:
        self.autopilot = autopilot
        self.now = now
        self._codec = mavlink.MAVLink(None, system_id, component_id)

    def encode(self, message: Any) -> bytes:
        frame = bytes(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256
        return frame

    def tell(self, message: Any) -> list[Any]:
        return decode(self.autopilot.receive(self.encode(message), self.now))

    def heartbeat(self) -> list[Any]:
        """Send a heartbeat of the station."""
        return self.tell(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 0, 3))

    def command(self, number: int, *parameters: float, target: tuple[int, int] = (1, 1)) -> list[Any]:
        """Send a COMMAND_LONG; the answers, of which the last is the acknowledgement."""
        seven = [*parameters, *[0.0] * (7 - len(parameters))]
        return self.tell(mavlink.MAVLink_command_long_message(*target, number, 0, *seven))

    def result(self, number: int, *parameters: float) -> int:
        acknowledgement = self.command(number, *parameters)[-1]
        assert acknowledgement.get_type() == "COMMAND_ACK"
        assert acknowledgement.command == number
        return int(acknowledgement.result)

    def wait(self, seconds: float, heartbeats: bool = True) -> list[Any]:
        """Advance in small steps, and return the autopilot's messages."""
        received: list[Any] = []
        end = self.now + seconds
        beat_at = self.now
        while self.now < end:
            if heartbeats and self.now >= beat_at:
                beat_at += 1
                received += self.heartbeat()
            self.now = min(end, self.now + 0.05)
            received += decode(self.autopilot.advance(self.now))
        return received

    def take_off(self, altitude_m: float = 5.0) -> None:
        """Bring the copter up, and wait until it is there."""
        assert self.result(mavlink.MAV_CMD_DO_SET_MODE, 1, 4) == mavlink.MAV_RESULT_ACCEPTED
        assert self.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == mavlink.MAV_RESULT_ACCEPTED
        assert self.result(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, altitude_m) == mavlink.MAV_RESULT_ACCEPTED
        self.wait(3 + altitude_m)


def decode(frames: list[bytes]) -> list[Any]:
    """The messages in frames, each of which must be whole and genuine."""
    codec = mavlink.MAVLink(None)
    return [codec.decode(bytearray(frame)) for frame in frames]


def of_type(messages: list[Any], name: str) -> list[Any]:
    return [message for message in messages if message.get_type() == name]
