"""The attacks of a captured member against real parsers: each succeeds without the filter and fails with it."""

from __future__ import annotations

import pytest

from tests.mavlink.parsers.captured_member import MemberAttack, attacks_on
from tests.mavlink.parsers.judge import judge_all
from tests.mavlink.parsers.receivers import DIALECTS, EVERY_LOSS, Batch, Receiver, all_receivers
from tests.mavlink.parsers.targets import concatenated, deliver, judge_of

# Receivers that accept the hidden frame in simply concatenated frames, from the stream's first byte on.
_RESUMES = frozenset(
    {
        *("parse_char", "parse_char, MAVLink 2 only", "parse_char, signing, unsigned too"),
        "parse_char, MAVLink 2 only, signing, unsigned too",
        *("parse_char, CRC_EXTRA 0 for unknown messages", "parse_char, other definitions"),
    }
)
_MAVLINK1_TOO = frozenset(item for item in _RESUMES if "MAVLink 2 only" not in item)
_OF_MAVLINK1 = frozenset({"parse_char, library of MAVLink 1", "frame_char_buffer, library of MAVLink 1"})
_GOALS = ("flight termination", "forced arming", "SETUP_SIGNING", "SET_MODE", "a ground station's HEARTBEAT")
BEFORE: dict[str, frozenset[str]] = {
    **{f"observer: {goal}, {how}": _RESUMES for goal in _GOALS for how in ("signed", "checksum")},
    "observer: legal lengths": _MAVLINK1_TOO | _OF_MAVLINK1,
    "operator: a command": _RESUMES,
    "vehicle: command to the ground station": _RESUMES,
    "no policy: SETUP_SIGNING": _RESUMES,
    "vehicle: restart in MAVLink 1": _MAVLINK1_TOO,
    "swarm-member: SET_MODE in MAVLink 1": _OF_MAVLINK1,
    "swarm-member: COMMAND_LONG in MAVLink 1": _OF_MAVLINK1,
    "swarm-member: command after a loss": frozenset(),
    "swarm-member: command after a loss, ATTITUDE of 255 bytes": frozenset(),
    "swarm-member: a ground station's HEARTBEAT after a loss": frozenset(),
    "swarm-member: read as MAVLink 1 after a loss": frozenset(),
    "two members, MAVLink 1": _OF_MAVLINK1,
    "two members, MAVLink 2": frozenset(),
}
# Of 300 random losses of 1 to 300 bytes, the least number after which `mavlink_parse_char` accepts the hidden frame.
AFTER_LOSSES = {
    "swarm-member: command after a loss": 30,
    "swarm-member: command after a loss, ATTITUDE of 255 bytes": 150,
    "swarm-member: a ground station's HEARTBEAT after a loss": 150,
    "two members, MAVLink 2": 60,
}
REPEATED = 20
SHORT = "common"
EACH_DIALECT = {item: pytest.param(item, marks=() if item == SHORT else pytest.mark.long) for item in DIALECTS}
LARGE = [EACH_DIALECT[item] for item in ("common", "ardupilotmega", "all")]


def named(dialect: str, name: str) -> MemberAttack:
    """The attack of this name against this dialect."""
    return next(attack for attack in attacks_on(dialect) if attack.name == name)


def suffix(receiver: Receiver) -> str:
    """A receiver's name without its dialect."""
    return receiver.name.partition(", ")[2]


def test_every_attack_is_in_the_table() -> None:
    """The table of this test has the attacks of the catalogue."""
    assert sorted(attack.name for attack in attacks_on("common")) == sorted(BEFORE)


@pytest.mark.parametrize("name", BEFORE)
@pytest.mark.parametrize("dialect", LARGE)
def test_attack_succeeds_with_concatenated_frames(dialect: str, name: str) -> None:
    """Without the filter exactly these receivers accept the forbidden frame."""
    attack = named(dialect, name)
    stream = concatenated(attack).delivery
    reached = {suffix(item) for item in all_receivers([dialect]) if attack.goal in item.accepts(*stream)}
    assert reached == BEFORE[name]


@pytest.mark.parametrize("how", ["signed", "checksum"])
def test_concatenated_frames_reach_a_receiver_of_the_smallest_dialect(how: str) -> None:
    """`minimal` has only HEARTBEAT: a ground station's is accepted."""
    attack = named("minimal", f"observer: a ground station's HEARTBEAT, {how}")
    stream = concatenated(attack).delivery
    assert {suffix(item) for item in all_receivers(["minimal"]) if attack.goal in item.accepts(*stream)} == _RESUMES


@pytest.mark.parametrize("name", AFTER_LOSSES)
def test_attack_succeeds_with_concatenated_frames_after_a_loss(name: str) -> None:
    """Without the filter the receiver accepts the forbidden frame after so many of 300 random losses."""
    attack = named("common", name)
    batch = Batch([concatenated(attack, REPEATED).delivery])
    _, accepted = Receiver("common", "2.0").judge(batch, losses=300)
    reached = {(item.lost_at, item.lost) for item in accepted if item.raw == attack.goal and item.lost_at >= 0}
    assert len(reached) >= AFTER_LOSSES[name]


@pytest.mark.parametrize("name", BEFORE)
@pytest.mark.parametrize("dialect", EACH_DIALECT.values())
def test_filter_stops_it(dialect: str, name: str) -> None:
    """No receiver accepts a forbidden frame: from any offset, after any loss of up to 300 bytes."""
    attack = named(dialect, name)
    once = deliver(attack)
    repeated = deliver(attack, times=REPEATED)
    receivers, judge = all_receivers([dialect]), judge_of(attack)
    verdicts = judge_all([once], receivers, judge, losses=EVERY_LOSS)
    assert not verdicts.breaches
    assert not judge_all([repeated], receivers, judge, losses=100).breaches
