"""A captured swarm member floods a serial line, and the operator's commands arrive all the same."""

from __future__ import annotations

import pytest

from tests.endpoints.starvation import (
    BAUD,
    COMMANDS,
    HEARTBEATS,
    RATES_KBIT_S,
    Make,
    member_heartbeat,
    position,
    starve,
)
from uavlinkd.endpoints.serial import IN_FLIGHT_S

ADDED_S = 0.05
LINE_BYTES_S = BAUD / 10


@pytest.mark.parametrize("kbit_s", RATES_KBIT_S)
@pytest.mark.parametrize("flood", [position, member_heartbeat])
def test_flood_on_a_serial_line_delays_no_command(kbit_s: float, flood: Make) -> None:
    """At every rate of the flood each command and heartbeat arrives, in less than 50 ms more than on an idle line."""
    result = starve(kbit_s, flood)
    assert (result.commands, result.heartbeats) == (COMMANDS, HEARTBEATS)
    assert result.worst_added_s < ADDED_S
    assert result.most_held <= IN_FLIGHT_S * LINE_BYTES_S


def test_line_is_used_while_frames_wait() -> None:
    """A short kernel queue does not leave the line idle: the flood gets what the operator leaves."""
    result = starve(64, position)
    of_operator = 50 * 45 + 10 * 21
    assert result.flood_frames * len(position(0)) > 0.98 * (10 * LINE_BYTES_S - of_operator)
