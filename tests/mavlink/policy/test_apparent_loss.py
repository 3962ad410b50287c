"""The loss that ground control software computes from sequence numbers, if a policy refuses frames."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from tests.mavlink.policy.test_role_rates import FLIGHTS, flight
from uavlinkd.mavlink.frames import MAVLINK1, Frame
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.policy.roles import ROLES

PAGE = Path(__file__).parents[3] / "uavlinkd" / "config" / "README.md"
AUTOPILOT = 1, 1


def reported_loss(frames: Iterable[Frame]) -> float:
    """Gaps in the autopilot's sequence numbers in percent, as MAVLink's own receivers compute it."""
    received, missing, expected = 0, 0, None
    for frame in frames:
        if (frame.header.system, frame.header.component) != AUTOPILOT:
            continue
        number = frame.raw[2] if frame.raw[0] == MAVLINK1 else frame.raw[4]
        missing += 0 if expected is None else (number - expected) % 256
        received, expected = received + 1, number + 1
    return 100 * missing / (received + missing)


def stated() -> dict[str, tuple[float, float]]:
    """The least and the greatest loss of each role, as the page says."""
    rows = re.findall(r"^\| `([a-z-]+)` \| .* \| ([\d.]+)(?: to ([\d.]+))? % \|$", PAGE.read_text(), re.MULTILINE)
    return {role: (float(least), float(most or least)) for role, least, most in rows}


@pytest.mark.parametrize("role", ROLES)
def test_page_states_the_loss_that_a_role_causes(shared_data: Path, role: str) -> None:
    """In addition to the gaps of the recording itself."""
    caused = []
    for name in FLIGHTS:
        policy = compile_policy({"role": role, "system_ids": "all"})
        gate = policy.incoming if role == "vehicle" else policy.outgoing
        recorded = flight(shared_data / name)
        passed = [frame for now, frame in recorded if gate.check(frame, now) is None]
        caused.append(reported_loss(passed) - reported_loss(frame for _, frame in recorded))
    least, most = stated()[role]
    assert least == pytest.approx(min(caused), abs=1)
    assert most == pytest.approx(max(caused), abs=1)
    if most < 1:
        assert max(caused) <= most
