"""``uavlinkd evaluate flight``: errors and ages of believed positions, the attacks, the report, and a quick run."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from random import Random

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests import waiting
from tests.lab.evaluation.quick_runs import run_quickly
from tests.needs import need
from uavlinkd.core import wire
from uavlinkd.lab.evaluation.flight_attacks import DisplaceOptions, DisplacePositions, Drift, ExchangeWatch
from uavlinkd.lab.evaluation.flight_findings import FlightFindings, flight_problems, read_flight, summary
from uavlinkd.lab.evaluation.flight_links import PaperLink
from uavlinkd.lab.evaluation.flight_plan import ATTACKS, NAME, AttackPhase, FlightSettings, LinkKind
from uavlinkd.lab.evaluation.flight_positions import (
    Belief,
    Flown,
    Origin,
    Place,
    Provenance,
    Receiver,
    displace,
    samples,
)
from uavlinkd.lab.evaluation.records import Record, RecordWriter, Value
from uavlinkd.lab.mitm.attack import AttackContext, Direction, Send

ORIGIN = Origin(47.0, 8.0)
HERE = (470_000_000, 80_000_000)
"""Latitude and longitude of the origin, as in frames."""
CONTEXT = AttackContext.between("drone0", "drone1")
THERE = Direction("drone0", "drone1")


def position(latitude_e7: int, longitude_e7: int, time_ms: int = 1000, system: int = 1) -> bytes:
    """A GLOBAL_POSITION_INT."""
    codec = mavlink.MAVLink(None, system, 1)
    message = mavlink.MAVLink_global_position_int_message(time_ms, latitude_e7, longitude_e7, 5000, 5000, 1, 2, 3, 90)
    return bytes(message.pack(codec))


def heartbeat() -> bytes:
    """A HEARTBEAT."""
    return bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mavlink.MAVLink(None, 1, 1)))


def test_place_is_in_metres_from_the_origin() -> None:
    """1e-7 degrees of latitude are 11 mm everywhere, of longitude less away from the equator."""
    place = ORIGIN.place_in(position(HERE[0] + 10_000, HERE[1] + 10_000))

    assert place is not None
    assert place.north_m == pytest.approx(111.32, abs=0.01)
    assert place.east_m == pytest.approx(75.92, abs=0.01)
    assert ORIGIN.place_in(heartbeat()) is None
    assert ORIGIN.place_in(b"\xfd") is None


def test_displaced_frame_is_valid_and_moved() -> None:
    """The checksum, the time and the altitude stay right. Another message stays unchanged."""
    moved = displace(position(*HERE), 30.0, -40.0)

    place = ORIGIN.place_in(moved)
    assert place is not None
    assert (place.east_m, place.north_m) == pytest.approx((30.0, -40.0), abs=0.02)
    message = mavlink.MAVLink(None).decode(bytearray(moved))
    assert (message.time_boot_ms, message.alt, message.get_srcSystem()) == (1000, 5000, 1)
    assert displace(heartbeat(), 30.0, 40.0) == heartbeat()


def test_flown_place_is_between_the_positions_sent() -> None:
    """Linear in time; before the first and after the last position, that one."""
    flown = Flown()
    flown.add(1.0, Place(0.0, 0.0))
    flown.add(2.0, Place(10.0, 20.0))

    assert flown.at(1.25) == Place(2.5, 5.0)
    assert flown.at(0.0) == flown.at(1.0) == Place(0.0, 0.0)
    assert flown.at(2.0) == flown.at(9.0) == Place(10.0, 20.0)


def test_error_and_age_are_those_of_the_last_accepted_position() -> None:
    """A late position is as old as its sending; before the first one there is no sample."""
    flown = Flown()
    for second in range(6):
        flown.add(float(second), Place(3.0 * second, 4.0 * second))
    beliefs = [
        Belief(1.0, 1.0, Place(3.0, 4.0), Provenance.GENUINE),
        Belief(3.0, 0.0, Place(0.0, 0.0), Provenance.REPLAYED),
    ]

    taken = list(samples(flown, beliefs, 0.0, 5.0, 1.0))

    assert [(sample.at, sample.error_m, sample.age_s) for sample in taken] == [
        (1.0, 0.0, 0.0),
        (2.0, 5.0, 1.0),
        (3.0, 15.0, 3.0),
        (4.0, 20.0, 4.0),
    ]


def test_receiver_knows_where_a_frame_comes_from() -> None:
    """Genuine once, replayed after that; a frame that was never sent is altered, and as old as its arrival."""
    sent = {position(*HERE): 0.5, heartbeat(): 0.6}
    receiver = Receiver(ORIGIN, sent)

    receiver.accept(position(*HERE), 1.0)
    receiver.accept(heartbeat(), 1.1)
    receiver.accept(position(*HERE), 2.0)
    receiver.accept(position(HERE[0] + 100, HERE[1]), 3.0)

    assert receiver.frames == [
        (1.0, Provenance.GENUINE),
        (1.1, Provenance.GENUINE),
        (2.0, Provenance.REPLAYED),
        (3.0, Provenance.ALTERED),
    ]
    assert [belief.sent_at for belief in receiver.beliefs] == [0.5, 0.5, 3.0]


@pytest.mark.parametrize("header", [b"", wire.envelope_header(7, 9)], ids=["bare", "in an envelope"])
def test_positions_are_displaced_without_a_key(header: bytes) -> None:
    """Header, other frames and tag stay as they are. Datagrams without a position pass."""
    tag = bytes(range(16)) if header else b""
    attack = DisplacePositions(DisplaceOptions.model_validate({"step_m": 5.0}), CONTEXT, Random(0), 0.0)

    sent = [
        action.datagram
        for action in attack.on_datagram(header + heartbeat() + position(*HERE) + tag, THERE, 1.0)
        if isinstance(action, Send)
    ]

    assert sent == [header + heartbeat() + Drift(5.0, 60.0).move(position(*HERE)) + tag]
    quiet = header + heartbeat() + tag
    assert attack.on_datagram(quiet, THERE, 2.0) == [Send(quiet, THERE)]


def test_drift_grows_up_to_its_limit() -> None:
    """So a receiver sees a flight and no jump; each aircraft has its own."""
    drift = Drift(4.0, 10.0)
    origin = Place(0.0, 0.0)

    distances = []
    for _ in range(4):
        place = ORIGIN.place_in(drift.move(position(*HERE)))
        assert place is not None
        distances.append(place.distance_m(origin))
    assert distances == pytest.approx([4.0, 8.0, 10.0, 10.0], abs=0.02)
    other = ORIGIN.place_in(drift.move(position(*HERE, system=2)))
    assert other is not None
    assert other.distance_m(origin) == pytest.approx(4.0, abs=0.02)


def test_watch_notes_the_exchange_that_was_answered() -> None:
    """Neither data before the exchange counts, nor a first message that was sent again."""
    watch = ExchangeWatch()
    envelope, key = wire.envelope_header(1, 0) + heartbeat() + bytes(32), bytes(256)
    for now, datagram, direction in (
        (1.0, envelope, THERE),
        (2.0, b"\1" + key, THERE),
        (3.0, b"\1" + key, THERE),
        (3.5, b"\2" + key, THERE.reverse),
        (4.0, envelope, THERE),
        (5.0, envelope, THERE),
    ):
        assert watch.on_datagram(datagram, direction, now) == [Send(datagram, direction)]

    assert (watch.key_at, watch.data_at) == (3.0, 4.0)


def test_plan_tries_each_attack_with_a_pause_before_it() -> None:
    """The first phase is as long as the age of what is replayed: the attacker records meanwhile."""
    for settings in (FlightSettings(), FlightSettings(quick=True)):
        phases = settings.phases()
        assert [phase for phase, _ in phases[1::2]] == list(ATTACKS)
        assert {phase for phase, _ in phases[::2]} == {AttackPhase.QUIET}
        assert phases[0][1] == settings.replay_delay_s


RUN: dict[str, Value] = {"aircraft": "our simulator", "quick": True, "seed": 3, "began": "2026-01-02", "cores": 2}


def some_records() -> list[Record]:
    """Records of a short run in which all is as expected."""
    records = [Record("exchange", {"link": "paper"}, {"first_position_s": 0.2, "began_s": 0.1, "took_s": 0.06})]
    for link in LinkKind:
        for number, phase in enumerate(AttackPhase):
            begin_s = 2.0 * number
            weak = link is not LinkKind.OURS
            counts: dict[str, Value] = {
                "sent": 40,
                "interventions": 20,
                "genuine": 0 if phase is AttackPhase.DROP else 40,
                "replayed": 40 if weak and phase is AttackPhase.REPLAY else 0,
                "altered": 20 if weak and phase in (AttackPhase.ALTER, AttackPhase.KEYS) else 0,
                "noticed": "" if weak else "20 bad_tag",
                "begin_s": begin_s,
                "end_s": begin_s + 2.0,
            }
            records.append(Record("phase", {"link": link.value, "phase": phase.value}, counts))
            for tick in range(20):
                at = begin_s + tick / 10
                error = 30.0 if weak and phase is not AttackPhase.QUIET else 0.5
                values: dict[str, Value] = {
                    "at_s": at,
                    "flown_east_m": 8 * at,
                    "flown_north_m": 0.0,
                    "believed_east_m": 8 * at,
                    "believed_north_m": error,
                    "error_m": error,
                    "age_s": error / 8,
                    "accepted_at_s": at,
                    "provenance": "genuine",
                }
                point = {"link": link.value, "aircraft": "drone0", "phase": phase.value}
                records.append(Record("sample", point, values))
    records += [
        Record("state", {"link": "uavlinkd"}, {"at_s": 10.5, "state": "link down"}),
        Record("state", {"link": "uavlinkd"}, {"at_s": 12.0, "state": ""}),
        Record("end", {}, {"duration_s": 12.0, "load_after": 1.0}),
    ]
    return records


def test_summary_has_errors_and_accepted_frames() -> None:
    """In one flat object."""
    facts = summary(FlightFindings(RUN, some_records()))

    assert (facts["paper_replayed_accepted"], facts["ours_replayed_accepted"]) == (40, 0)
    assert (facts["plain_altered_accepted"], facts["ours_altered_accepted"]) == (40, 0)
    assert (facts["paper_max_error_m"], facts["ours_max_error_m"]) == (30.0, 0.5)
    assert facts["paper_max_error_m_quiet"] == 0.5
    assert (facts["paper_max_unnoticed_error_m"], facts["ours_max_unnoticed_error_m"]) == (30.0, 0.5)
    assert (facts["duration_s"], facts["paper_key_exchange_s"], facts["aircraft"]) == (12.0, 0.06, "our simulator")
    json.dumps(facts, allow_nan=False)


def test_reported_states_have_begin_and_end() -> None:
    """From one change to the next; the last one until the end of the flight."""
    records = some_records()
    assert FlightFindings(RUN, records).states(LinkKind.OURS) == [("link down", 10.5, 12.0)]
    without_end = [record for record in records if record.values.get("state") != ""]
    assert FlightFindings(RUN, without_end).states(LinkKind.OURS) == [("link down", 10.5, 12.0)]
    assert FlightFindings(RUN, records).states(LinkKind.PAPER) == []


@pytest.mark.parametrize(
    ("link", "phase", "name", "value", "problem"),
    [
        (LinkKind.OURS, AttackPhase.REPLAY, "replayed", 1, "accepted 1 replayed"),
        (LinkKind.OURS, AttackPhase.KEYS, "altered", 2, "accepted 2 altered"),
        (LinkKind.OURS, AttackPhase.ALTER, "genuine", 0, "delivered no frame"),
        (LinkKind.PAPER, AttackPhase.REPLAY, "replayed", 0, "no effect on paper"),
        (LinkKind.PAPER, AttackPhase.KEYS, "altered", 0, "no effect on paper"),
        (LinkKind.PLAIN, AttackPhase.ALTER, "altered", 0, "no effect on plain"),
    ],
)
def test_deviation_is_a_problem(link: LinkKind, phase: AttackPhase, name: str, value: int, problem: str) -> None:
    """An accepted false frame, a link that is cut by more than drops, or an attack without effect."""
    records = some_records()
    assert flight_problems(FlightFindings(RUN, records)) == []
    point = {"link": link.value, "phase": phase.value}
    changed = [
        replace(record, values={**record.values, name: value})
        if record.kind == "phase" and record.point == point
        else record
        for record in records
    ]
    (line,) = flight_problems(FlightFindings(RUN, changed))
    assert problem in line


def test_unreported_attack_is_a_problem() -> None:
    """A daemon must report soon that nothing arrives. A phase of a quick run is too short for this."""
    records = [record for record in some_records() if record.kind != "state"]
    assert flight_problems(FlightFindings(RUN, records)) == []
    longer = [
        replace(record, values={**record.values, "end_s": record.number("begin_s") + 15.0})
        if record.point.get("phase") == AttackPhase.DROP and record.kind == "phase"
        else record
        for record in records
    ]
    (line,) = flight_problems(FlightFindings(RUN, longer))
    assert 'did not report within 10 s of "drop"' in line
    down = Record("state", {"link": "uavlinkd"}, {"at_s": 12.0, "state": "link down"})
    ended = Record("end", {}, {"duration_s": 30.0, "load_after": 1.0})
    assert flight_problems(FlightFindings(RUN, [*longer[:-1], down, ended])) == []


def test_error_is_unnoticed_until_a_state_is_reported() -> None:
    """A position counts until the daemon reports that the link is down, and a later position after that."""
    records = some_records()
    for at, accepted_at, error in ((10.4, 10.0, 4.0), (10.6, 10.0, 80.0), (12.1, 10.0, 90.0), (12.2, 12.1, 5.0)):
        values: dict[str, Value] = {"at_s": at, "accepted_at_s": accepted_at, "error_m": error}
        point = {"aircraft": "drone1", "phase": AttackPhase.DROP.value}
        records += [Record("sample", {"link": link.value, **point}, values) for link in LinkKind]
    findings = FlightFindings(RUN, records)
    assert findings.unnoticed_error_m(LinkKind.OURS) == 5.0
    assert findings.unnoticed_error_m(LinkKind.PAPER) == 90.0


def test_interrupted_run_is_a_problem() -> None:
    """Its records end early."""
    (line,) = flight_problems(FlightFindings(RUN, some_records()[:-1]))
    assert "interrupted" in line


@pytest.mark.parametrize("is_quick", [True, False])
def test_report_says_what_a_quick_run_does_not_check(is_quick: bool) -> None:
    """Its attacks are shorter than the time in which a daemon must report them."""
    need(find_spec("matplotlib") is not None, "matplotlib, for the figures")
    from uavlinkd.lab.evaluation.flight_report import make_sections

    sections = make_sections(FlightFindings({**RUN, "quick": is_quick}, some_records()))
    text = " ".join(paragraph for section in sections for paragraph in section.paragraphs)
    assert ("does not check that the daemons report an attack within 10 s" in text) is is_quick


def test_no_text_of_the_figure_covers_another() -> None:
    """Titles, labels, ticks and legends; every axis has a label with its unit, on the outer panels."""
    need(find_spec("matplotlib") is not None, "matplotlib, for the figures")
    from tests.lab.evaluation.test_figures import boxes_of, overlaps
    from uavlinkd.lab.evaluation.flight_figures import draw_flight

    figure = draw_flight(FlightFindings(RUN, some_records()))
    figure.savefig(io.BytesIO(), format="png")
    boxes = boxes_of(figure)
    assert {"east (m)", "north (m)", "time since take-off (s)", "uavlinkd reports: link down"} <= {
        t for t, _ in boxes
    }
    assert overlaps(boxes) == []


def test_figure_shows_every_point() -> None:
    """Also the largest error, which only one link has."""
    need(find_spec("matplotlib") is not None, "matplotlib, for the figures")
    from numpy import asarray

    from uavlinkd.lab.evaluation.flight_figures import draw_flight

    records = [
        replace(record, values={**record.values, "error_m": 90.0, "believed_north_m": 90.0})
        if record.kind == "sample" and record.point["link"] == "paper" and record.point["phase"] == AttackPhase.KEYS
        else record
        for record in some_records()
    ]
    figure = draw_flight(FlightFindings(RUN, records))
    figure.savefig(io.BytesIO(), format="png")
    largest = []
    for axes in figure.axes:
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        points: list[tuple[float, float]] = [
            (x, y) for line in axes.lines for x, y in asarray(line.get_xydata(), float).tolist()
        ]
        assert all(left <= x <= right and bottom <= y <= top for x, y in points)
        largest.append(max(y for _, y in points))
    assert largest == [30.0, 90.0, 0.5] * 2


def test_report_is_made_again_from_the_records(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Figure, HTML, Markdown and page, and the same bytes each time."""
    need(find_spec("matplotlib") is not None, "matplotlib, for the figures")
    from uavlinkd.cli import main

    with RecordWriter(tmp_path, NAME, RUN) as writer:
        for record in some_records():
            writer.add(record)
    page = tmp_path / "page" / "RESULTS-flight.md"

    assert main(["evaluate", "report", str(tmp_path), "--page", str(page)]) == 0

    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "flight.html"), str(page)]
    svg = (tmp_path / "flight.svg").read_bytes()
    assert (tmp_path / "flight.html").read_text().count("data:image/svg+xml;base64,") == 1
    assert "(results/flight.svg)" in page.read_text()
    assert (page.parent / "results" / "flight.svg").read_bytes() == svg
    assert main(["evaluate", "report", str(tmp_path)]) == 0
    assert (tmp_path / "flight.svg").read_bytes() == svg


@pytest.mark.long
async def test_quick_run(tmp_path: Path) -> None:
    """uavlinkd accepts no false position, the paper's protocol does. The error output names what it does not use."""
    need(find_spec("matplotlib") is not None, "matplotlib, for the figures")
    run = await run_quickly("flight", tmp_path, UAVLINKD_ARDUPILOT="/missing", UAVLINKD_PX4="")
    unused = "UAVLINKD_ARDUPILOT is not used: --quick flies our simulator\n"
    assert (run.status, run.err) == (0, unused)

    facts = json.loads(run.out.splitlines()[-1])
    assert (facts["ours_replayed_accepted"], facts["ours_altered_accepted"]) == (0, 0)
    assert min(facts["paper_replayed_accepted"], facts["paper_altered_accepted"], facts["plain_altered_accepted"]) > 0
    assert facts["paper_max_error_m_replay"] > facts["ours_max_error_m_replay"]
    assert facts["aircraft"] == "our simulator"
    findings = read_flight(tmp_path)
    assert facts == summary(findings)
    assert [span.phase for span in findings.spans] == [phase for phase, _ in FlightSettings(quick=True).phases()]
    for link in LinkKind:
        assert findings.of("sample", link=link, aircraft="drone0")
        assert findings.of("sample", link=link, aircraft="drone1")
    for exchange in findings.of("exchange", link=LinkKind.OURS):
        assert exchange.number("began_s") > 0, "the keys are exchanged after take-off"
    assert "replayed" in findings.noticed(LinkKind.OURS, AttackPhase.REPLAY)
    assert "bad_tag" in findings.noticed(LinkKind.OURS, AttackPhase.ALTER)
    assert (tmp_path / "flight.html").read_text().count("data:image/svg+xml;base64,") == 1
    interventions = [json.loads(line) for line in (tmp_path / "mitm-flight-uavlinkd.jsonl").read_text().splitlines()]
    attacks = {line["attack"] for line in interventions if line["event"] == "intervention"}
    assert attacks >= {"duplicate", "displace-positions", "hold", "drop"}


async def test_papers_link_exchanges_keys_once_and_again_around_a_relay(tmp_path: Path) -> None:
    """A relay between both ends alters positions; after it, the ends have a key of their own again."""
    delivered: list[bytes] = []
    link = PaperLink(
        FlightSettings(quick=True), tmp_path / "mitm.jsonl", lambda _name, frame: delivered.append(frame)
    )
    await link.open()
    try:
        frames = iter(position(*HERE, time_ms=number) for number in range(1_000_000))

        async def until_delivered(is_genuine: bool) -> None:
            sent: set[bytes] = set()

            def arrived() -> bool:
                frame = next(frames)
                sent.add(frame)
                link.send("drone0", frame)
                return bool(delivered) and (delivered[-1] in sent) == is_genuine

            delivered.clear()
            await waiting.until(arrived)

        await until_delivered(is_genuine=True)
        exchange = link.watch.key_at
        assert exchange is not None
        await link.attack(AttackPhase.KEYS)
        await until_delivered(is_genuine=False)
        await link.attack(AttackPhase.QUIET)
        await until_delivered(is_genuine=True)
        assert link.watch.key_at == exchange
        assert not (await link.notice()).counts.keys() - {"hmac_mismatch"}
    finally:
        await link.close()
