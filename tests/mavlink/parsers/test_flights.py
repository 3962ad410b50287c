"""Honest traffic passes: recorded flights, and random telemetry. Only frames that span lost bytes are a risk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.mavlink.parsers.figures import false_refusals, of_attacker
from tests.samples import frames_of
from uavlinkd.lab.sim.tlog import TlogRecord, read_tlog
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source

FLIGHTS = ("arducopter_sitl_flight.tlog", "ardusub_dive.tlog", "copter_flight_mavlink1.tlog")
GROUND = 255
# What the roles refuse on purpose: a companion's positions for its own autopilot, and a message that the dialect
# defines differently.
LEFT_OUT: dict[str, dict[tuple[str, str], int]] = {
    "ardusub_dive.tlog": {("GPS_INPUT", "message_not_allowed"): 1011},
    "copter_flight_mavlink1.tlog": {("RESOURCE_REQUEST", "unknown_message"): 1314},
}


def parsed(records: Sequence[TlogRecord]) -> list[tuple[float, Frame]]:
    """The log time of each frame, in seconds, and the frame, without broken ones."""
    return [(record.time_us / 1e6, frame) for record in records for frame in frames_of([record.frame])]


@pytest.mark.parametrize("name", FLIGHTS)
def test_recorded_flight_passes(shared_data: Path, name: str) -> None:
    """Every frame of vehicle and ground station, by policy, rates and invariant, in both directions, unchanged."""
    flight = parsed(read_tlog(shared_data / name).records)
    systems = sorted({frame.header.system for _, frame in flight} - {0, GROUND})
    vehicle = Policy({"role": "vehicle", "system_ids": systems})
    operator = Policy({"role": "operator", "system_ids": [GROUND]})
    sources = {True: Source("operator", operator.incoming), False: Source("vehicle", vehicle.incoming)}
    streams = {True: DeliveredStream(), False: DeliveredStream()}
    refused: Counter[tuple[str, str]] = Counter()
    first = flight[0][0]
    for at_s, frame in flight:
        is_ground = frame.header.system == GROUND
        source = sources[is_ground]
        refusal = source.gate.check(frame, max(0.0, at_s - first))
        if refusal is not None:
            refused[name_of(frame.header.msgid), refusal] += 1
        elif streams[is_ground].admit(frame, source, at_s) != frame.raw:
            refused[name_of(frame.header.msgid), "hidden_frame"] += 1
    assert refused == LEFT_OUT.get(name, {})


def test_random_telemetry_passes() -> None:
    """A frame of random floats is refused accidentally, less than once in a million."""
    result = false_refusals(300_000, seed=1)
    assert result.refused <= 1
    assert result.frame_bytes >= 300_000


def test_attacker_that_knows_the_length_has_a_share_of_the_offsets() -> None:
    """Five offsets of each of its frames, of at least 24 bytes; no frame that spans no loss."""
    share = of_attacker(36)
    assert 0.15 < share.forbidden / share.losses < 0.25
    assert share.elsewhere == 0
