"""``uavlinkd evaluate paths``: the frames, the plan, the radios, and a quick run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import waiting
from tests.lab.evaluation.quick_runs import run_quickly
from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.paths_findings import paths_problems, paths_summary
from uavlinkd.lab.evaluation.paths_plan import QUICK_MEANS, STATION, VEHICLE, PathsSettings, RadioChange, Scenario
from uavlinkd.lab.evaluation.paths_run import PATHS
from uavlinkd.lab.evaluation.paths_traffic import NumberedFlow, PathLink, PathRadio, PathWatch, TrafficLog, flows_of
from uavlinkd.lab.mitm.attack import Direction, Send
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.mavlink.frames import SplitCounters, split_datagram

THERE = Direction(VEHICLE, STATION)


@pytest.mark.parametrize("flow", flows_of(Scenario.MANUAL), ids=lambda flow: f"{flow.sender} {flow.message}")
def test_frames_of_a_flow_are_valid_and_unique(flow: NumberedFlow) -> None:
    """The daemon's own splitter knows their message, and their class is that of the flow."""
    counters = SplitCounters()
    frames = [flow.frame(number) for number in range(300)]
    split = split_datagram(b"".join(frames), counters)

    assert [frame.raw for frame in split] == frames
    assert len(set(frames)) == 300
    assert {frame.header.kind.cls for frame in split} == {flow.cls}
    assert {frame.header.is_known for frame in split} == {True}
    assert (counters.unknown, counters.garbage_bytes) == (0, 0)


def test_deliveries_are_matched_to_the_frames_that_were_sent() -> None:
    """By their bytes: late and repeated ones too, but no frame of others, and none from before the beginning."""
    traffic = TrafficLog(flows_of(Scenario.QUIET))
    early = traffic.next_frame(0)
    traffic.begin()
    frames = [traffic.next_frame(0) for _ in range(3)]
    for frame in (frames[0], frames[2], frames[2], frames[1], early, b"another"):
        traffic.on_received(frame)

    record = traffic.records({"scenario": "quiet"})[0]
    assert record.values["numbers"] == [0, 2, 2, 1]
    assert len(record.values["sent_s"]) == 3
    assert traffic.arrived_from == {VEHICLE}


@pytest.mark.parametrize("scenario", [s for s in Scenario if s is not Scenario.DEATHS])
@pytest.mark.parametrize("is_quick", [True, False])
def test_one_path_works_at_any_time(scenario: Scenario, is_quick: bool) -> None:
    """Else no daemon could carry the frames. At the end, both radios are as at the beginning."""
    plan = PathsSettings(is_quick).plan(scenario)
    now: dict[tuple[int, str], bool] = {}
    for change in sorted(plan.changes, key=lambda change: change.at_s):
        for direction in ("vehicle>station", "station>vehicle"):
            if change.directions in ("both", direction):
                now[change.radio, direction] = change.values.get("loss") != 1.0 and "is_stalled" not in change.values
        at_once = [other for other in plan.changes if other.at_s == change.at_s]
        if change is at_once[-1]:
            for direction in ("vehicle>station", "station>vehicle"):
                assert now.get((0, direction), True) or now.get((1, direction), True), change
        assert change.at_s < plan.duration_s
    assert all(now.values())
    for failure in plan.failures:
        assert RadioChange(failure.until_s, failure.radio) in plan.changes


def test_watch_notes_the_classes_of_the_frames_in_an_envelope() -> None:
    """Also behind a control record, and before a tag."""
    telemetry, command = (
        next(flow for flow in flows_of(Scenario.QUIET) if flow.message == message)
        for message in ("ATTITUDE", "COMMAND_ACK")
    )
    header = bytes((5, 1, 0, 7))  # a short envelope: type, index, counter
    watch = PathWatch()
    datagrams = [header + bytes(22) + telemetry.frame(1) + bytes(16), header + command.frame(2) + bytes(16)]
    for number, datagram in enumerate(datagrams):
        assert watch.on_datagram(datagram, THERE, float(number)) == [Send(datagram, THERE)]
    assert dict(watch.carried) == {(VEHICLE, Class.STREAM): [0.0], (VEHICLE, Class.CRITICAL): [1.0]}
    assert watch.on_datagram(header + bytes(30), THERE, 2.0)
    assert (watch.datagrams, watch.bytes) == (3, sum(map(len, datagrams)) + 34)


async def test_duplicated_link_delivers_what_one_radio_holds() -> None:
    """Users get each frame twice, and frames of any age after a stall."""
    arrived: list[bytes] = []
    radios = {number: PathRadio(RadioSettings(), number) for number in range(2)}
    link = PathLink(radios, arrived.append)
    try:
        await link.open()
        flow = flows_of(Scenario.QUIET)[0]
        first, held, last = (flow.frame(number) for number in range(3))
        link.send(VEHICLE, first)
        await waiting.until(lambda: arrived == [first, first])
        radios[0].change(RadioChange(0.0, 0, {"is_stalled": True}))
        link.send(VEHICLE, held)
        link.send(VEHICLE, last)
        await waiting.until(lambda: arrived == [first, first, held, last])
        radios[0].change(RadioChange(0.0, 0))
        await waiting.until(lambda: arrived == [first, first, held, last, held, last])
        link.send(STATION, first)
        await waiting.until(lambda: arrived[6:] == [first, first])
    finally:
        await link.close()


@pytest.mark.long
async def test_quick_run(tmp_path: Path) -> None:
    """Duplicates deliver stale frames and one path loses critical ones; the last line has the facts."""
    result = await run_quickly("paths", tmp_path)
    run = PATHS.read(tmp_path)
    facts = json.loads(result.out.splitlines()[-1])
    assert facts == paths_summary(run)
    assert result.err.splitlines() == paths_problems(run)
    assert result.status == bool(paths_problems(run))
    assert (facts["stale_delivered"], facts["delivered_twice"], facts["states_back"]) == (0, 0, 0)
    assert (facts["critical_lost"], facts["one_path_critical_lost"] > 0) == (0, True)
    assert min(facts["duplicated_stale_delivered"], facts["duplicated_states_back"]) > 0
    assert {(trial.scenario, trial.means) for trial in run.trials} == {
        (scenario, means) for scenario, chosen in QUICK_MEANS.items() for means in chosen
    }
    report = (tmp_path / "paths.md").read_text()
    assert all(f"(paths-{name}.svg)" in report for name in ("dies", "stalls"))
