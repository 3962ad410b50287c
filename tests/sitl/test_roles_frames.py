"""The generator covers what the role tables pass, and nothing else."""

from __future__ import annotations

import pytest

from tests.sitl.roles_frames import ROLES_TESTED, RoleFrames
from uavlinkd.mavlink.dialect import MESSAGES, name_of
from uavlinkd.mavlink.frames import SplitCounters, parse_frame, split_datagram
from uavlinkd.mavlink.policy.compilation import Policy

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


def test_seed_repeats_the_frames() -> None:
    """So a run can be repeated."""
    first, second = (RoleFrames("swarm-member", seed=9) for _ in range(2))
    assert [first.draw() for _ in range(500)] == [second.draw() for _ in range(500)]
