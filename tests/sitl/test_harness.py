"""The harness itself: it finds differences between two ends, and flies our own simulator without a binary.

The generator covers what the role tables pass, and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.processes.frames import frame, heartbeat
from tests.sitl.downloads import judged
from tests.sitl.ledger import Passing, compare, compare_by, number_of, source_of
from tests.sitl.pilots import Place
from tests.sitl.relayed import problem_of
from tests.sitl.roles import LIMITS_M, Snapshot, differences
from tests.sitl.roles_frames import ROLES_TESTED, RoleFrames
from tests.sitl.scenarios import Run, fly
from tests.sitl.transfers import Figures
from uavlinkd.mavlink.dialect import MESSAGES, name_of
from uavlinkd.mavlink.frames import SplitCounters, parse_frame, split_datagram
from uavlinkd.mavlink.policy.compilation import Policy

SENT = [Passing(10.0 + number / 10, frame(number)) for number in range(20)]


def arrived(*numbers: int) -> list[Passing]:
    """Frames that arrive 0.05 s after they were sent, or after the one before."""
    received: list[Passing] = []
    for number in numbers:
        at = max(SENT[number].at + 0.05, received[-1].at if received else 0.0)
        received.append(Passing(at, SENT[number].frame))
    return received


@pytest.mark.parametrize(
    ("numbers", "missing", "duplicated", "reordered"),
    [
        (range(20), 0, 0, 0),
        ([*range(5), *range(6, 20)], 1, 0, 0),
        ([*range(6), *range(5, 20)], 0, 1, 0),
        ([0, 2, 1, *range(3, 20)], 0, 0, 1),
    ],
)
def test_difference_is_counted(numbers: Sequence[int], missing: int, duplicated: int, reordered: int) -> None:
    """A lost, a repeated and an overtaken frame; frames from before the period do not count."""
    result = compare(SENT, arrived(*numbers), 10.0, 12.0)
    assert (result.missing.total(), result.duplicated, result.reordered) == (missing, duplicated, reordered)
    assert (result.sent, result.arrived, result.figures()["p50_ms"]) == (20, 20 - missing, 50.0)
    assert result.is_exact == (numbers == range(20))
    assert compare(SENT, arrived(*numbers), 11.0, 12.0).sent == 10
    assert not result.foreign


def test_altered_frame_differs_from_an_equal_one() -> None:
    """An altered frame was never sent, and one is missing. Frames of 256 later have the same bytes."""
    received = arrived(*range(20))
    data = received[7].frame
    received[7] = Passing(received[7].at, data[:12] + bytes([data[12] ^ 1]) + data[13:])
    result = compare(SENT, received, 10.0, 12.0)
    assert (result.missing.total(), result.foreign.total()) == (1, 1)
    sent = [*SENT[:3], Passing(11.0, SENT[0].frame)]
    result = compare(sent, [*arrived(1, 2), Passing(11.05, SENT[0].frame)], 10.0, 12.0)
    assert (result.missing.total(), result.reordered) == (1, 0)


def test_order_counts_for_each_key() -> None:
    """A heartbeat overtakes telemetry: of another sender it may, of the same one only if its message is the key."""
    own, other = (Passing(SENT[0].at + 0.01, heartbeat(system)) for system in (1, 2))
    for beat, by_source in ((own, 1), (other, 0)):
        sent, received = [SENT[0], beat, SENT[1]], [Passing(beat.at + 0.01, beat.frame), *arrived(0, 1)]
        assert compare(sent, received, 10.0, 12.0).reordered == 1
        assert compare_by(source_of, sent, received, 10.0, 12.0).reordered == by_source
        assert compare_by(number_of, sent, received, 10.0, 12.0).is_exact
    swapped = [Passing(passing.at + 1, passing.frame) for passing in (SENT[1], SENT[0])]
    assert compare_by(number_of, SENT[:2], swapped, 10.0, 12.0).reordered == 1


def test_overtaken_frame_is_judged() -> None:
    """pymavlink counts 256 lost frames for one that arrives late, or rejects its signature and counts one."""
    codec = mavlink.MAVLink(None, 1, 1)
    for signing, rejected, loss_percent in ((None, 0, 96.2), ((b"k" * 32, 10**12), 1, 10.0)):
        if signing:
            codec.signing.secret_key, codec.signing.timestamp = signing
            codec.signing.sign_outgoing = True
        frames = []
        for number in range(250, 260):
            codec.seq = number % 256
            frames.append(bytes(mavlink.MAVLink_system_time_message(0, 0).pack(codec)))
        order: Figures = {"frames": 10, "overtaken": 0, "packet_loss_percent": 0.0, "rejected": 0}
        assert judged(frames, signing) == order
        late = judged([frames[0], frames[2], frames[1], *frames[3:]], signing)
        assert late == order | {"overtaken": 1, "packet_loss_percent": loss_percent, "rejected": rejected}


CALM = {"failsafe": False, "altered": 0, "duplicated": 0, "reordered": 0, "critical_lost": 0, "stream_gap_s": 0.2}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({}, ""),
        ({"failsafe": True}, "the failsafe tripped"),
        ({"altered": 1}, "1 frames altered"),
        ({"critical_lost": 2}, "2 critical frames lost"),
        ({"stream_gap_s": 0.7}, "0.7 s without telemetry"),
        ({"critical_lost": 9, "stream_gap_s": 3.0, "down_back_s": 0.1, "up_back_s": 0.2}, ""),
        ({"down_back_s": 0.1, "up_back_s": 2.1}, "back after 2.1 s"),
    ],
)
def test_dead_relay_is_judged(change: dict[str, Any], problem: str) -> None:
    """Two relays lose nothing critical. With one, frames are lost until it is back."""
    assert problem_of(CALM | change) == problem


CALM_STATE = Snapshot(
    {"armed": False, "mode": 4, "plan 0": "[]", "FENCE_ENABLE": b"\0\0\0\0"},
    dict.fromkeys(LIMITS_M, Place(469_480_000, 74_474_000, 540.0)),
    1_700_000_000.0,
    {"ATTITUDE": 4.0, "HEARTBEAT": 1.0},
)


@pytest.mark.parametrize(
    "change",
    [
        {"exact": {**CALM_STATE.exact, "mode": 5}},
        {"exact": {**CALM_STATE.exact, "FENCE_ENABLE": b"\0\0\0\1"}},
        {"exact": {**CALM_STATE.exact, "NEW": b""}},
        {"places": {**CALM_STATE.places, "HOME_POSITION": Place(469_490_000, 74_474_000, 540.0)}},
        {"places": {**CALM_STATE.places, "HOME_POSITION": Place(469_480_000, 74_474_000, math.nan)}},
        {"places": {**CALM_STATE.places, "GPS_GLOBAL_ORIGIN": None}},
        {"clock_s": 0.0},
        {"rates": {"ATTITUDE": 1.0, "HEARTBEAT": 1.0}},
        {"rates": {**CALM_STATE.rates, "RAW_IMU": 2.0}},
    ],
)
def test_change_by_a_role_is_reported(change: dict[str, Any]) -> None:
    """One sentence for each change; none for a centimetre of home, some milliseconds, or one message."""
    assert len(differences(CALM_STATE, replace(CALM_STATE, **change))) == 1
    places = {**CALM_STATE.places, "HOME_POSITION": Place(469_480_000, 74_474_001, 540.1)}
    rates = {"ATTITUDE": 4.1, "HEARTBEAT": 1.1, "AUTOPILOT_VERSION": 0.1}
    later = replace(CALM_STATE, places=places, clock_s=1_700_000_000.2, rates=rates)
    assert differences(CALM_STATE, later) == []


@pytest.mark.long
async def test_roles_change_nothing_in_own_simulator() -> None:
    """On the ground and in the air."""
    record = await fly(Run("roles", "own"))
    assert record.error is None, record
    assert len(record.figures["attacks"]) == 4


@pytest.mark.long
async def test_own_simulator_flies() -> None:
    """Parameters and a mission of 100 items, every frame counted: the same code as with a real autopilot."""
    record = await fly(Run("parameters-mission", "own"))
    assert record.error is None, record
    assert record.figures["frames"]["exact"]


FRAMES = 5000


@pytest.mark.parametrize("role", ROLES_TESTED)
def test_each_frame_passes_the_role(role: str) -> None:
    """A gate of its own permits every frame, in MAVLink 1 and 2, signed and unsigned."""
    frames = RoleFrames(role, seed=3)
    gate = Policy(frames.policy).incoming
    drawn = [frames.draw() for _ in range(FRAMES)]
    split = [frame for raw in drawn for frame in split_datagram(raw, SplitCounters())]
    assert len(split) == FRAMES
    assert all(gate.permits(frame) for frame in split)
    assert {frame.header.is_mavlink1 for frame in split} == {False, True}
    assert {frame.header.system for frame in split} == set(frames.systems)
    assert len({frame.header.component for frame in split}) > 250
    targets = {frame.header.target_system for frame in split}
    assert targets >= {0, 1, 255, *frames.systems} if role == "observer" else targets == {0}
    assert any(frame.raw[0] == 0xFD and frame.raw[2] for frame in split)


@pytest.mark.parametrize("role", ROLES_TESTED)
def test_every_message_and_command_is_drawn(role: str) -> None:
    """Those that the gate's table passes: it decides by message, then by command."""
    frames = RoleFrames(role, seed=4)
    split = [frame for _ in range(FRAMES) if (frame := parse_frame(frames.draw().lstrip(b"\2"))) is not None]
    gate = Policy(frames.policy).incoming
    for msgid in MESSAGES:
        name = name_of(msgid)
        commands = {frame.header.command for frame in split if frame.header.msgid == msgid}
        if msgid in frames.messages:
            assert frames.by_message[name] > FRAMES // len(frames.messages) // 2
            verdict = gate.decide(msgid, is_known=True)
            only = getattr(verdict, "only_commands", None)
            assert only is None or commands == only
        else:
            assert not commands
