"""Rates of roles: a recorded flight passes unchanged, and a flood does not."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.samples import attitude, frame, heartbeat
from uavlinkd.lab.sim.tlog import read_tlog
from uavlinkd.mavlink.dialect import ids_by_name
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.policy.gate import SYSTEM_SHARE, Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES

FLIGHTS = ("arducopter_sitl_flight.tlog", "ardusub_dive.tlog", "copter_flight_mavlink1.tlog")
WITH_RATES = ("swarm-member", "observer")


@cache
def flight(path: Path) -> list[tuple[float, Frame]]:
    """The genuine frames of a recorded flight, and the time of each."""
    counters = SplitCounters()
    return [
        (record.time_us / 1e6, frame)
        for record in read_tlog(path).records
        for frame in split_payload(record.frame, counters)
    ]


def incoming(role: str, **more: object) -> Gate:
    return compile_policy({"role": role, "system_ids": "all", **more}).incoming


def position(number: int, component: int = 1) -> Frame:
    return frame(mavlink.MAVLink_global_position_int_message(number, 1, 2, 3, 4, 5, 6, 7, 8), 1, component)


@pytest.mark.parametrize("name", FLIGHTS)
@pytest.mark.parametrize("role", ROLES)
def test_recorded_flight_passes_unchanged(shared_data: Path, role: str, name: str) -> None:
    """No frame of a flight that its role allows exceeds its rate."""
    gate = incoming(role)
    verdicts = [gate.check(frame, now) for now, frame in flight(shared_data / name)]
    assert Refusal.RATE_LIMITED not in verdicts
    assert None in verdicts


def test_follow_me_has_its_positions() -> None:
    """Ten positions a second pass, also if a link delivers half a second of them at once."""
    gate = incoming("swarm-member")
    assert all(gate.check(position(n), n / 10) is None for n in range(600))
    assert all(gate.check(position(n), 60.0 + n // 5 * 0.5) is None for n in range(600))


@pytest.mark.parametrize(("components", "rates"), [(1, 1), (250, SYSTEM_SHARE)])
def test_flood_of_positions_is_limited(components: int, rates: int) -> None:
    """Of two thousand a second, 50 of one component pass, and sixteen times that of a whole system."""
    gate = incoming("swarm-member")
    seconds = 5
    passed = sum(gate.check(position(n, n % components + 1), n / 2000) is None for n in range(2000 * seconds))
    assert 50 * rates * seconds <= passed <= 50 * rates * (seconds + 0.5)


@pytest.mark.parametrize("role", ROLES)
def test_only_roles_that_do_not_operate_have_rates(role: str) -> None:
    """An operator and a vehicle have no limit."""
    assert bool(ROLES[role].rate_in) is (role in WITH_RATES)


@pytest.mark.parametrize("role", WITH_RATES)
def test_every_message_of_the_role_has_a_rate(role: str) -> None:
    """Every message that the role allows has a limit."""
    gate = incoming(role)
    unlimited = {name for name, msgid in ids_by_name().items() if gate.decide(msgid, is_known=True) is None}
    assert unlimited == set()


def test_own_rate_replaces_the_roles() -> None:
    """A rate in the configuration, of the message or of a group with it, replaces the role's; others stay."""
    for own in ({"ATTITUDE": 500}, {"position": 500}):
        gate = incoming("swarm-member", rate_in=own)
        assert sum(gate.check(attitude(n), n / 400) is None for n in range(400)) == 400
        assert sum(gate.check(heartbeat(n), n / 400) is None for n in range(400)) < 10
