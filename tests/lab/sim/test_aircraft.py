"""An aircraft of an evaluation that does not obey. `uavlinkd evaluate flight --quick` has one that does."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim import aircraft as ground_pilot
from uavlinkd.lab.sim.aircraft import GroundPilot, PilotError


async def test_copter_that_does_not_arm_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if it accepts the command to arm each time."""
    monkeypatch.setattr(ground_pilot, "READY_S", 0.0)
    monkeypatch.setattr(ground_pilot, "ANSWER_S", 0.0)
    codec = mavlink.MAVLink(None, 7, 1)
    commands: list[int] = []

    def accept(frame: bytes) -> None:
        command = mavlink.MAVLink(None).decode(bytearray(frame)).command
        commands.append(command)
        for message in (
            mavlink.MAVLink_command_ack_message(command, mavlink.MAV_RESULT_ACCEPTED),
            mavlink.MAVLink_global_position_int_message(0, 470_000_000, 80_000_000, 0, 0, 0, 0, 0, 0),
        ):
            pilot.receive(bytes(message.pack(codec)))

    pilot = GroundPilot(7, accept, lambda: None)
    with pytest.raises(PilotError, match="system ID 7: it did not arm"):
        await pilot.take_off(3.0, 20.0)
    assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM in commands
    assert mavlink.MAV_CMD_NAV_TAKEOFF not in commands
