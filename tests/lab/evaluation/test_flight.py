"""``uavlinkd evaluate flight``: errors and ages of believed positions, the attacks, the report, and a quick run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests import waiting
from tests.lab.evaluation.quick_runs import run_quickly
from uavlinkd.core import wire
from uavlinkd.lab.evaluation.flight_links import PaperLink
from uavlinkd.lab.evaluation.flight_plan import (
    AttackPhase,
    Belief,
    DisplacePositions,
    Drift,
    FlightSettings,
    Flown,
    LinkKind,
    Origin,
    Place,
    Provenance,
    Receiver,
    samples,
)
from uavlinkd.lab.evaluation.flight_report import FlightFindings, flight_problems, summary
from uavlinkd.lab.evaluation.flight_run import FLIGHT
from uavlinkd.lab.evaluation.records import Record, Value
from uavlinkd.lab.mitm.attack import AttackContext, Direction, Send

ORIGIN = Origin(47.0, 8.0)
HERE = (470_000_000, 80_000_000)
"""Latitude and longitude of the origin, as in frames."""
CONTEXT = AttackContext.between("drone0", "drone1")
THERE = Direction("drone0", "drone1")


def position(latitude_e7: int, longitude_e7: int, time_ms: int = 1000, system: int = 1) -> bytes:
    codec = mavlink.MAVLink(None, system, 1)
    message = mavlink.MAVLink_global_position_int_message(time_ms, latitude_e7, longitude_e7, 5000, 5000, 1, 2, 3, 90)
    return bytes(message.pack(codec))


def heartbeat() -> bytes:
    return bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mavlink.MAVLink(None, 1, 1)))


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
    attack = DisplacePositions(DisplacePositions.options_model.model_validate({}), CONTEXT, Random(0), 0.0)

    sent = [
        action.datagram
        for action in attack.on_datagram(header + heartbeat() + position(*HERE) + tag, THERE, 1.0)
        if isinstance(action, Send)
    ]

    assert sent == [header + heartbeat() + Drift().move(position(*HERE)) + tag]
    quiet = header + heartbeat() + tag
    assert attack.on_datagram(quiet, THERE, 2.0) == [Send(quiet, THERE)]


RUN: dict[str, Value] = {"quick": True, "seed": 3}


def some_records() -> list[Record]:
    """Records of a short run in which all is as expected."""
    records: list[Record] = []
    for link in LinkKind:
        for number, phase in enumerate(AttackPhase):
            begin_s = 2.0 * number
            weak = link is not LinkKind.OURS
            counts: dict[str, Value] = {
                "sent": 40,
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
        Record("end", {}, {"duration_s": 12.0, "aircraft": "our simulator"}),
    ]
    return records


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
    assert max(findings.unnoticed_errors_m(LinkKind.OURS)) == 5.0
    assert max(findings.unnoticed_errors_m(LinkKind.PAPER)) == 90.0


@pytest.mark.long
async def test_quick_run(tmp_path: Path) -> None:
    """uavlinkd accepts no false position, the paper's protocol does. A quick run flies our simulator."""
    run = await run_quickly("flight", tmp_path, UAVLINKD_ARDUPILOT="/missing", UAVLINKD_PX4="")
    assert (run.status, run.err) == (0, "")

    facts = json.loads(run.out.splitlines()[-1])
    assert (facts["ours_replayed_accepted"], facts["ours_altered_accepted"]) == (0, 0)
    assert min(facts["paper_replayed_accepted"], facts["paper_altered_accepted"], facts["plain_altered_accepted"]) > 0
    assert facts["paper_max_error_m_replay"] > facts["ours_max_error_m_replay"]
    assert facts["aircraft"] == "our simulator"
    findings = FLIGHT.read(tmp_path)
    assert facts == summary(findings)
    assert [phase for phase, _, _ in findings.spans] == [phase for phase, _ in FlightSettings(quick=True).phases()]
    for link in LinkKind:
        assert findings.of("sample", link=link, aircraft="drone0")
        assert findings.of("sample", link=link, aircraft="drone1")
    assert "replayed" in findings.noticed(LinkKind.OURS, AttackPhase.REPLAY)
    assert "bad_tag" in findings.noticed(LinkKind.OURS, AttackPhase.ALTER)
    assert "(flight.svg)" in (tmp_path / "flight.md").read_text()
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
        assert link._ends["drone0"].exchanges == 1
        await link.attack(AttackPhase.KEYS)
        await until_delivered(is_genuine=False)
        await link.attack(AttackPhase.QUIET)
        await until_delivered(is_genuine=True)
        assert link._ends["drone0"].exchanges == 3
        assert not (await link.notice()).counts.keys() - {"hmac_mismatch"}
    finally:
        await link.close()
