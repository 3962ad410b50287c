"""Totals of refused frames: by command where a frame carries one, in the codes of the specification."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.processes.frames import command_long, heartbeat
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.mavlink.policy import gate as gates
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import CODES, REFUSALS, Gate, Refusal
from uavlinkd.protocol import reports
from uavlinkd.protocol.wire import Refused

ARM, TAKE_OFF = 400, 22


def member() -> Gate:
    """What passes from a swarm member that is system 1."""
    return Policy({"role": "swarm-member", "system_ids": [1]}).incoming


def check(gate: Gate, *raws: bytes) -> None:
    """Judge frames of the peer."""
    for frame in split_payload(b"".join(raws), SplitCounters()):
        gate.check(frame, 0.0)


def test_codes_are_those_of_the_specification() -> None:
    """Each reason has a code, and the document lists the same."""
    text = (Path(reports.__file__).parent / "README.md").read_text()
    table = text.partition("### Refusal reports")[2].partition("Other codes are valid")[0]
    documented = {name: int(code) for code, name in re.findall(r"\| (\d+) \| `([a-z_0-9]+)`", table)}
    assert documented == {refusal.value: code for refusal, code in CODES.items()}
    assert set(CODES) == set(Refusal)
    assert {REFUSALS[code] for code in CODES.values()} == set(Refusal)


def test_commands_are_counted_by_number() -> None:
    """Two commands in the same message have an entry each; a frame of a foreign system too."""
    gate = member()
    check(gate, *(command_long(ARM, 1),) * 3, command_long(TAKE_OFF, 1), heartbeat(9), command_long(ARM, 9))
    assert sorted(gate.changed_totals()) == [
        Refused(0, 0, CODES[Refusal.FOREIGN_SYSTEM], 1),
        Refused(76, TAKE_OFF, CODES[Refusal.MESSAGE_NOT_ALLOWED], 1),
        Refused(76, ARM, CODES[Refusal.FOREIGN_SYSTEM], 1),
        Refused(76, ARM, CODES[Refusal.MESSAGE_NOT_ALLOWED], 3),
    ]


def test_commands_are_bounded() -> None:
    """Numbers without a name count for their message alone: however many there are, a known command is counted."""
    gate = member()
    check(gate, *(command_long(number, 1) for number in range(50000, 50100)), *(command_long(ARM, 1),) * 2)
    code = CODES[Refusal.MESSAGE_NOT_ALLOWED]
    assert sorted(gate.changed_totals()) == [Refused(76, 0, code, 100), Refused(76, ARM, code, 2)]
    assert len(gate.refused_commands) == 2


def test_messages_that_share_a_count_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their message is not known any more."""
    monkeypatch.setattr(gates, "MAX_COUNTED", 0)
    gate = member()
    check(gate, heartbeat(9))
    assert gate.refused
    assert gate.changed_totals() == []


def test_only_changes_are_reported() -> None:
    """Unchanged totals are left out."""
    gate = member()
    assert gate.changed_totals() == []
    check(gate, heartbeat(9), command_long(ARM, 1))
    assert len(gate.changed_totals()) == 2
    assert gate.changed_totals() == []
    check(gate, command_long(ARM, 1))
    assert gate.changed_totals() == [Refused(76, ARM, CODES[Refusal.MESSAGE_NOT_ALLOWED], 2)]
