"""``uavlinkd evaluate paths``: the frames, the plan, the radios, and a quick run."""

from __future__ import annotations

import json
import os
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests import waiting
from tests.lab.evaluation.quick_runs import run_quickly
from tests.needs import need
from uavlinkd.config.load import load_config
from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.paths_findings import (
    paths_problems,
    paths_summary,
    read_paths,
)
from uavlinkd.lab.evaluation.paths_links import DaemonsLink, DuplicatedLink, PathRadio, PathWatch
from uavlinkd.lab.evaluation.paths_plan import (
    CONDITIONS,
    QUICK_MEANS,
    STATION,
    VEHICLE,
    PathsSettings,
    RadioChange,
    Scenario,
)
from uavlinkd.lab.evaluation.paths_traffic import NumberedFlow, TrafficLog, flows_of
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


@pytest.mark.parametrize("scenario", Scenario)
def test_mix_is_that_of_a_flight(scenario: Scenario) -> None:
    """At least 51 frames of the stream a second, and commands; manual control in one scenario only."""
    flows = flows_of(scenario)
    assert sum(flow.rate_hz for flow in flows if (flow.sender, flow.cls) == (VEHICLE, Class.STREAM)) >= 51
    assert {flow.sender for flow in flows if flow.cls is Class.CRITICAL} == {VEHICLE, STATION}
    assert any(flow.message == "MANUAL_CONTROL" for flow in flows) is (scenario is Scenario.MANUAL)


def test_deliveries_are_matched_to_the_frames_that_were_sent() -> None:
    """By their bytes: late and repeated ones too, but no frame of others, and none from before the beginning."""
    traffic = TrafficLog(flows_of(Scenario.QUIET))
    early = traffic.next_frame(0)
    traffic.begin()
    frames = [traffic.next_frame(0) for _ in range(3)]
    for frame in (frames[0], frames[2], frames[2], frames[1], early, b"another"):
        traffic.on_received(frame)

    record = traffic.records({"scenario": "quiet"})[0]
    assert record.list_of("numbers") == [0, 2, 2, 1]
    assert len(record.list_of("sent_s")) == 3
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


def test_full_run_has_every_scenario_and_condition() -> None:
    """With the means of today beside ours; a quick run has one round of some."""
    settings = PathsSettings(tlogs=(Path("flight.tlog"),))
    rounds = settings.rounds()
    assert {plan.scenario for trials in rounds for plan, _ in trials} == set(Scenario)
    deaths = [plan for trials in rounds for plan, _ in trials if plan.scenario is Scenario.DEATHS]
    assert [(plan.point["rtt_ms"], plan.point["jitter_ms"]) for plan in deaths] == list(CONDITIONS)
    assert {plan.deaths for plan in deaths} == {settings.repeats}
    (quick,) = PathsSettings(quick=True).rounds()
    assert {(plan.scenario, means) for plan, means in quick} == {
        (scenario, means) for scenario, chosen in QUICK_MEANS.items() for means in chosen
    }


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
    assert watch.bytes_of == {"stream": len(datagrams[0]), "critical": len(datagrams[1]), "records": 34}


async def test_duplicated_link_delivers_what_one_radio_holds() -> None:
    """Users get each frame twice, and frames of any age after a stall."""
    arrived: list[bytes] = []
    radios = {number: PathRadio(RadioSettings(), number) for number in range(2)}
    link = DuplicatedLink(radios, arrived.append)
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


def test_vehicle_has_two_networks_if_one_is_metered(tmp_path: Path) -> None:
    """Each address of the station belongs to one of them."""
    radios = {number: PathRadio(RadioSettings(), number) for number in range(2)}
    link = DaemonsLink(radios, lambda _frame: None, tmp_path / "daemons", {}, is_metered=True)
    link.configure(["127.0.0.1:14001", "127.0.0.1:14002"])
    vehicle, station = (
        load_config(daemon.folder / "drone.toml", os.environ)
        for daemon in (link.daemons[VEHICLE], link.daemons[STATION])
    )
    assert [network.metered for network in vehicle.networks] == [False, True]
    names = [network.name for network in vehicle.networks]
    assert [(str(a.address), a.network) for a in vehicle.peers[0].addresses] == list(
        zip(["127.0.0.1:14001", "127.0.0.1:14002"], names, strict=True)
    )
    assert (station.networks, station.peers[0].addresses) == ((), ())


@pytest.mark.long
async def test_quick_run(tmp_path: Path) -> None:
    """Duplicates deliver stale frames and one path loses critical ones; the last line has the facts."""
    need(find_spec("matplotlib") is not None, "matplotlib, for the figures")
    result = await run_quickly("paths", tmp_path)
    run = read_paths(tmp_path)
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
    assert (tmp_path / "paths.html").read_text().count("data:image/svg+xml;base64,") == 3
