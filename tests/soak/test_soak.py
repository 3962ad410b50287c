"""The soak itself: a short one passes, and the verdict reports each problem of a long one."""

from __future__ import annotations

import copy
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.soak.__main__ import OK, SUMMARY, report
from tests.soak.flows import SETTLED_S, Flow, frame, numbers_in
from tests.soak.judge import SAMPLES, judge, read_samples
from tests.soak.run import Plan, record

SECONDS = 14.0
"""With start and end about 20 s: long enough for an outage and two changes of keys."""


@pytest.mark.long
async def test_a_short_soak_loses_nothing_but_what_the_radio_dropped(tmp_path: Path) -> None:
    """Every frame that left the radio is delivered once, in the radio's order, over new keys and an outage."""
    samples = io.StringIO()
    await record(Plan(SECONDS, rekey_s=5.0, every_s=2.0), samples, print)
    (tmp_path / SAMPLES).write_text(samples.getvalue())
    assert report(tmp_path) == OK
    summary = json.loads((tmp_path / SUMMARY).read_text())
    assert summary["is_complete"]
    for flow in summary["flows"].values():
        assert flow["sent"] == flow["delivered"] + flow["radio_lost"] > 0.5 * SECONDS * Plan(0).rate
        assert flow["radio_lost"] > 0.02 * flow["sent"]
        assert flow["out_of_order"] > 0, "that was a gentle radio"
    assert all(generation >= 2 for generation in summary["rekeys"].values())
    assert any(drops.get("duplicate") for drops in summary["drops"].values()), "copies that the radio made"


def test_numbers_are_read_among_other_bytes() -> None:
    """Frames of the given system, several in an envelope, in order."""
    envelope = b"\x40\x01\xfd" + frame(7, 1) + frame(0xFD12, 2) + frame(9, 1) + bytes(16)
    assert numbers_in(envelope, 1) == [7, 9]
    assert numbers_in(envelope, 2) == [0xFD12]
    assert numbers_in(envelope[:30], 1) == []


STEPS: dict[str, Callable[[Flow], None]] = {
    "not_sent": lambda flow: flow.on_sent(1, 0.0),
    "radio_lost": lambda flow: flow.on_entered(1),
    "daemon_lost": lambda flow: flow.on_left(1),
    "delivered": lambda flow: flow.on_delivered(1, 0.5),
}
"""How far a frame gets, and what it counts as if it gets no further."""


def _flow(fate: str = "delivered") -> Flow:
    flow = Flow()
    for name, step in STEPS.items():
        step(flow)
        if name == fate:
            break
    return flow


@pytest.mark.parametrize("fate", STEPS)
def test_each_fate_is_counted(fate: str) -> None:
    """When it is settled, not before."""
    flow = _flow(fate)
    flow.settle(SETTLED_S - 0.001)
    assert flow.counts()["sent"] == 0
    flow.settle(SETTLED_S)
    assert {name: count for name, count in flow.counts().items() if count} == {"sent": 1, fate: 1}


def test_duplicated_invented_and_reordered_frames_are_counted() -> None:
    """A second delivery, one that was never sent, one that the radio or a daemon reordered."""
    flow = Flow()
    for number in (1, 2, 3):
        flow.on_sent(number, 0.0)
        flow.on_entered(number)
    for number in (2, 1, 3):  # the radio's order
        flow.on_left(number)
    for number in (2, 1, 1):
        flow.on_delivered(number, 0.1)
    flow.on_delivered(9, 0.1)
    counts = flow.counts()
    assert (counts["duplicated"], counts["invented"], counts["out_of_order"], counts["reordered"]) == (1, 1, 1, 0)
    other = Flow()
    for number in (1, 2):
        other.on_sent(number, 0.0)
        other.on_left(number)
    for number in (2, 1):
        other.on_delivered(number, 0.1)
    assert other.counts()["reordered"] == 1


def _sample(at_s: float, *, at_rest: bool = False) -> dict[str, Any]:
    flow = _flow()
    flow.settle(SETTLED_S)
    return {
        "at_s": at_s,
        "at_rest": at_rest,
        "processes": {"drone0": {"rss_kb": 40_000, "fds": 9}},
        "flows": {"drone0>ground": {**flow.counts(), "p50_s": 0.04, "p99_s": 0.05}},
        "taps": {"drone0>ground": {"entered": 10, "left": 9}},
        "radio": {"drone0>ground": {"sent": 10, "lost": 1, "lost_in_outage": 1, "duplicated": 1}},
        "radio_errors": {},
        "peers": {"drone0: ground": {"generation": 3, "state": "up", "drops": {}}},
        "lost_peers": {"drone0": 0},
    }


def _good_run() -> list[dict[str, Any]]:
    hour = [_sample(60.0 * minute) for minute in range(61)]
    return [*hour, _sample(3605.0, at_rest=True)]


def _leak(samples: list[dict[str, Any]]) -> None:
    for sample in samples:
        sample["processes"]["drone0"]["rss_kb"] += int(sample["at_s"] / 3)


def _descriptor(samples: list[dict[str, Any]]) -> None:
    samples[30]["processes"]["drone0"]["fds"] = 10


def _last(*path: str, value: object) -> Callable[[list[dict[str, Any]]], None]:
    def change(samples: list[dict[str, Any]]) -> None:
        place = samples[-1]
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("harm", "problem"),
    [
        (_leak, "memory grew by"),
        (_descriptor, "file descriptors changed"),
        (_last("flows", "drone0>ground", "daemon_lost", value=1), "came out of the radio and were not delivered"),
        (_last("flows", "drone0>ground", "not_sent", value=1), "never given to the radio"),
        (_last("flows", "drone0>ground", "duplicated", value=1), "delivered twice"),
        (_last("flows", "drone0>ground", "reordered", value=1), "out of order"),
        (_last("flows", "drone0>ground", "invented", value=1), "without having been sent"),
        (_last("flows", "drone0>ground", "delivered", value=0), "nothing was delivered"),
        (_last("taps", "drone0>ground", "left", value=8), "the taps saw"),
        (_last("lost_peers", "drone0", value=1), "lost a peer"),
        (_last("radio_errors", value={"Connection refused": 1}), "the radio had errors"),
        (_last("peers", "drone0: ground", "generation", value=0), "no new keys"),
    ],
)
def test_each_fault_of_a_long_run_is_reported(harm: Callable[[list[dict[str, Any]]], None], problem: str) -> None:
    samples = copy.deepcopy(_good_run())
    harm(samples)
    (reported,) = judge(samples)["problems"]
    assert problem in reported


def test_an_incomplete_last_line_is_ignored(tmp_path: Path) -> None:
    """The samples of a killed run can be reported."""
    (tmp_path / SAMPLES).write_text('{"at_s": 1}\n{"at_s": 2}\n{"at')
    assert [sample["at_s"] for sample in read_samples(tmp_path)] == [1, 2]
