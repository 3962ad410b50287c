"""``uavlinkd evaluate flight``: where frames come from, the attacks, the problems, and a quick run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.evaluation.quick_runs import run_quickly
from uavlinkd.lab.evaluation.flight_plan import (
    AttackPhase,
    DisplacePositions,
    Drift,
    FlightSettings,
    LinkKind,
    Origin,
    Provenance,
    Receiver,
)
from uavlinkd.lab.evaluation.flight_report import FlightFindings, flight_problems, summary
from uavlinkd.lab.evaluation.flight_run import FLIGHT
from uavlinkd.lab.evaluation.records import Record, Value
from uavlinkd.lab.mitm.attack import AttackContext, Direction, Send
from uavlinkd.protocol import wire

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
                "altered": 20 if weak and phase is AttackPhase.KEYS else 0,
                "noticed": "" if weak else "20 bad_tag",
                "begin_s": begin_s,
                "end_s": begin_s + 2.0,
            }
            records.append(Record("phase", {"link": link.value, "phase": phase.value}, counts))
    records += [
        Record("state", {}, {"at_s": 10.5, "state": "link down"}),
        Record("state", {}, {"at_s": 12.0, "state": ""}),
        Record("end", {}, {"duration_s": 12.0}),
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
    down = Record("state", {}, {"at_s": 12.0, "state": "link down"})
    ended = Record("end", {}, {"duration_s": 30.0, "load_after": 1.0})
    assert flight_problems(FlightFindings(RUN, [*longer[:-1], down, ended])) == []


@pytest.mark.long
async def test_quick_run(tmp_path: Path) -> None:
    """uavlinkd accepts no false position, the paper's protocol does."""
    run = await run_quickly("flight", tmp_path)
    assert (run.status, run.err) == (0, "")

    facts = json.loads(run.out.splitlines()[-1])
    assert (facts["ours_replayed_accepted"], facts["ours_altered_accepted"]) == (0, 0)
    assert min(facts["paper_replayed_accepted"], facts["paper_altered_accepted"]) > 0
    assert facts["paper_max_error_m_replay"] > facts["ours_max_error_m_replay"]
    findings = FLIGHT.read(tmp_path)
    assert facts == summary(findings)
    assert [phase for phase, _, _ in findings.spans] == [phase for phase, _ in FlightSettings(quick=True).phases()]
    assert all(findings.believed("errors_m", link) for link in LinkKind)
    assert "late_copy" in findings.noticed(LinkKind.OURS, AttackPhase.REPLAY)
    assert "bad_tag" in findings.noticed(LinkKind.OURS, AttackPhase.ALTER)
