"""The judge reports each kind of change, and the search names the frame that caused it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from tests.sitl.roles_judge import Snapshot, changed_rates, differences
from tests.sitl.roles_scene import narrow

BERNE = (46.948, 7.4474, 540.0)
STATE = Snapshot(
    armed=False,
    mode=4,
    parameters={"A": b"\0\0\0\0", "STAT_RUNTIME": b"\1\0\0\0"},
    plans={0: (b"home", b"first"), 1: (), 2: ()},
    home=BERNE,
    origin=BERNE,
    target=None,
    clock_s=1_700_000_000.0,
    rates={"ATTITUDE": 4.0, "HEARTBEAT": 1.0},
)


def test_equal_states_have_no_differences() -> None:
    """Nor do states that differ by what an autopilot changes by itself: a counter, a centimetre, one message."""
    later = replace(
        STATE,
        parameters={**STATE.parameters, "STAT_RUNTIME": b"\2\0\0\0"},
        home=(46.948, 7.4474, 540.1),
        clock_s=1_700_000_000.2,
        rates={"ATTITUDE": 4.1, "HEARTBEAT": 1.1, "AUTOPILOT_VERSION": 0.1, "STATUSTEXT": 5.0},
    )
    assert differences(STATE, later, ["STAT_RUNTIME"]) == []


@pytest.mark.parametrize(
    "changed",
    [
        {"armed": True},
        {"mode": 5},
        {"parameters": {**STATE.parameters, "A": b"\0\0\0\1"}},
        {"parameters": {"STAT_RUNTIME": b"\1\0\0\0"}},
        {"parameters": {**STATE.parameters, "B": b""}},
        {"plans": {**STATE.plans, 0: (b"home",)}},
        {"plans": {**STATE.plans, 2: (b"rally",)}},
        {"home": (46.949, 7.4474, 540.0)},
        {"home": None},
        {"origin": (46.948, 7.4474, 541.0)},
        {"target": BERNE},
        {"home": (float("nan"), 7.4474, 540.0)},
        {"clock_s": 0.0},
        {"rates": {"ATTITUDE": 1.0, "HEARTBEAT": 1.0}},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_change_is_reported(changed: dict[str, Any]) -> None:
    """One sentence for each change."""
    assert len(differences(STATE, replace(STATE, **changed), ["STAT_RUNTIME"])) == 1


def test_stream_that_ends_or_begins_is_reported() -> None:
    """Streams to the attacker too; answers to it do not count."""
    suffix = " to the attacker"
    before, after = {"ATTITUDE" + suffix: 4.0, "PARAM_VALUE" + suffix: 9.0}, {"RAW_IMU": 2.0}
    assert changed_rates(before, after) == [
        "rate of ATTITUDE to the attacker: 4.00/s became 0.00/s",
        "rate of RAW_IMU: 0.00/s became 2.00/s",
    ]


def test_one_frame_of_many_is_named() -> None:
    """By halves."""
    frames = [bytes([number % 251, number // 251]) for number in range(5000)]
    for culprit in (frames[0], frames[1234], frames[-1]):
        assert narrow(frames, lambda some, culprit=culprit: culprit in some) == [culprit]  # type: ignore[misc]


def test_frames_that_act_only_together_stay_together() -> None:
    """If neither half repeats the change, the search ends."""
    frames = [bytes([number]) for number in range(100)]
    pair = {frames[10], frames[20]}
    rest = narrow(frames, lambda some: pair <= set(some))
    assert pair <= set(rest)
    assert len(rest) <= 25
