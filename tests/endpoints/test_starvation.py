"""The operator's commands arrive although a captured swarm member floods a serial line."""

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
    without_starts,
)
from uavlinkd.endpoints.serial import IN_FLIGHT_S
from uavlinkd.mavlink.frames import MAX_FRAME_BYTES

ADDED_S = 0.05
LINE_BYTES_S = BAUD / 10


FLOODS = pytest.mark.parametrize("flood", [position, member_heartbeat])


@pytest.mark.parametrize("kbit_s", [*RATES_KBIT_S[:-1], pytest.param(RATES_KBIT_S[-1], marks=pytest.mark.long)])
@FLOODS
def test_flood_on_a_serial_line_delays_no_command(kbit_s: float, flood: Make) -> None:
    """At every rate of the flood each command and heartbeat arrives, in less than 50 ms more than on an idle line."""
    result = starve(kbit_s, without_starts(flood))
    assert (result.commands, result.heartbeats) == (COMMANDS, HEARTBEATS)
    assert result.worst_added_s < ADDED_S
    assert result.most_held <= IN_FLIGHT_S * LINE_BYTES_S


@FLOODS
def test_separator_bytes_delay_a_command_by_one_frame_at_most(flood: Make) -> None:
    """Where the flood's frames have start bytes inside, a command may wait behind one separator."""
    result = starve(512, flood)
    assert (result.commands, result.heartbeats) == (COMMANDS, HEARTBEATS)
    assert result.median_added_s < ADDED_S
    assert result.worst_added_s < ADDED_S + MAX_FRAME_BYTES / LINE_BYTES_S


def test_line_is_used_while_frames_wait() -> None:
    """A short kernel queue does not leave the line idle: the flood gets what the operator leaves."""
    result = starve(64, without_starts(position))
    of_operator = 50 * 45 + 10 * 21
    assert result.flood_frames * len(position(0)) > 0.98 * (10 * LINE_BYTES_S - of_operator)
