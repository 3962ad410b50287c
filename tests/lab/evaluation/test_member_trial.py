"""The row "captured member" of the tampering evaluation, and its judge."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavlinkd.lab.evaluation.captured_member import MemberAttack, attacks, set_mode
from uavlinkd.lab.evaluation.every_offset import forbidden_frames, frames_at_every_offset
from uavlinkd.lab.evaluation.hidden_frames import Carrier, frame
from uavlinkd.lab.evaluation.member_trial import NAME, MemberResult, Results, as_trial, run_attacks
from uavlinkd.lab.evaluation.tampering_records import Verdict
from uavlinkd.mavlink.policy.compilation import compile_policy

# Its second reading needs a lost byte: no frame before it ends with its start byte.
AFTER_A_LOSS = "swarm-member: read as MAVLink 1 after a loss"
CATALOGUE = [attack for attack in attacks(412, 8, 412, 8) if attack.name != AFTER_A_LOSS]


@pytest.mark.parametrize("attack", CATALOGUE, ids=lambda attack: attack.name)
def test_the_judge_finds_the_frame_that_an_attack_hides(attack: MemberAttack) -> None:
    """In the attack's frames, one behind the other."""
    at, delivered = 0, []
    for member, raw in attack.frames:
        delivered.append((at, raw, compile_policy(attack.members[member]).incoming))
        at += len(raw)
    assert attack.goal in forbidden_frames(attack.stream, delivered)


def test_the_judge_lets_a_source_hide_what_it_may_send() -> None:
    """A recorded frame of the vehicle itself in a file that it sends."""
    own = frame(30, bytes(28), 2)
    carrier = Carrier(110, bytearray(254), 2)
    carrier.payload[100 : 100 + len(own)] = own
    gate = compile_policy({"role": "vehicle", "system_ids": [2]}).incoming
    assert forbidden_frames(carrier.build(), [(0, carrier.build(), gate)]) == []


def test_the_search_reads_both_versions_at_every_offset() -> None:
    """Cut frames are not found."""
    one, two = set_mode(255), set_mode(255, version=1)
    result = list(frames_at_every_offset(b"\xfd\xfe" + one + b"\0" + two + two[:-1]))
    assert result == [(2, one), (3 + len(one), two)]


async def test_a_real_daemon_delivers_no_hidden_frame(tmp_path: Path) -> None:
    """Every attack of the catalogue is tried once, and what is refused is counted."""
    results = await run_attacks(tmp_path)
    assert len(results.outcomes) == len(CATALOGUE) + 1
    assert not [outcome for outcome in results.outcomes if outcome.forbidden]
    assert set(results.refused) == {"hidden_frame", "unknown_message"}
    assert [outcome.attack for outcome in results.outcomes if outcome.separators] == [
        "two members, MAVLink 1",
        "two members, MAVLink 2",
    ]
    trial = as_trial(results, 0.0, 1.0, 0)
    assert (trial.attack, trial.verdict) == (NAME, Verdict.DETECTED)


def test_a_hidden_frame_that_is_delivered_is_a_success_of_the_attacker() -> None:
    """The row names the attack."""
    results = Results([MemberResult("two members", 2, 2, 0, (b"x",))], last_wait_s=0.1)
    trial = as_trial(results, 0.0, 1.0, 0)
    assert trial.verdict is Verdict.SUCCEEDED
    assert trial.notes.endswith(": two members")
