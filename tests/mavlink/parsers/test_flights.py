"""Honest traffic passes: recorded flights, and random telemetry."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.mavlink.parsers.hidden_frames import frame as build
from tests.samples import frames_of
from tests.tlog import TlogRecord, read_tlog
from uavlinkd.mavlink.dialect import IDS, MESSAGES, name_of
from uavlinkd.mavlink.frames import Frame, parse_frame
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source

TELEMETRY = (
    *("ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "HOME_POSITION", "VFR_HUD"),
)


class Noise(NamedTuple):
    """The result: frames, bytes and refusals."""

    frames: int
    frame_bytes: int
    refused: int


def false_refusals(count: int, seed: int) -> Noise:
    """Deliver at least so many bytes of random telemetry of a swarm member."""
    rng = random.Random(seed)
    policy = {"role": "swarm-member", "system_ids": [1]}
    source, stream = Source("member", Policy(policy).incoming), DeliveredStream()
    numbers = [IDS[name] for name in TELEMETRY]
    frames = total = refused = 0
    while total < count:
        msgid = numbers[frames % len(numbers)]
        raw = build(msgid, rng.randbytes(MESSAGES[msgid][3]), 1, version=1 if frames % 8 == 7 else 2)
        parsed = parse_frame(raw)
        if parsed is None or not parsed.header.is_known:
            raw = build(msgid, rng.randbytes(MESSAGES[msgid][2]), 1, version=1)
            parsed = parse_frame(raw)
            assert parsed is not None
        total += len(raw)
        frames += 1
        refused += stream.admit(parsed, source, float(frames)) != raw
    return Noise(frames, total, refused)


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
    flight = parsed(read_tlog(shared_data / name))
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
