"""The stage for attacks on refusal reports: daemons that refuse commands of each other."""

from __future__ import annotations

import asyncio
from collections import Counter
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.waiting import PATIENCE_S
from uavlinkd.lab.evaluation.middle import MiddleHere
from uavlinkd.lab.evaluation.refusing_stage import RefusingStage, arm_command, claims_of, refused_by

PAIR = ("drone0", "drone1")


def test_the_command_is_one() -> None:
    """pymavlink reads COMPONENT_ARM_DISARM for the other drone."""
    message = mavlink.MAVLink(None).decode(bytearray(arm_command(1, 5)))
    assert (message.get_type(), message.command, message.target_system) == ("COMMAND_LONG", 400, 2)
    assert (message.get_srcSystem(), message.get_seq(), message.param1) == (1, 5, 1.0)


def test_a_false_claim_is_found() -> None:
    """A greater count, another reason, and another command differ from what was refused."""
    claim = {"message": "COMMAND_LONG", "command": "X", "reason": "r", "count": 5, "last_s": 0.0}
    claimed = claims_of({"peers": {"b": {"refused_there": [claim]}}}, "b")
    for counts, false in (({"r": 5}, {}), ({"r": 9}, {}), ({"r": 4}, {"X r": 1}), ({"q": 5}, {"X r": 5})):
        refused = refused_by({"peers": {"a": {"refused_commands": {"in": {"X": counts}}}}}, "a")
        assert claimed - refused == Counter(false)
    assert claims_of({}, "b") == refused_by({}, "b") == Counter()


async def test_altered_reports_change_no_claim(tmp_path: Path) -> None:
    """The attacker alters reports beside the genuine ones: drones show claims, and each is true."""
    middle = MiddleHere(PAIR, tmp_path / "mitm.jsonl", 1)
    async with RefusingStage(PAIR, tmp_path, middle, {"probe_interval_s": 1.0}, rate_hz=20.0) as stage:
        await middle.attack(["bit-flip,kinds=report,beside=true"])
        async with asyncio.timeout(PATIENCE_S):
            while True:
                attempts = sum((await middle.statistics()).counts.values())
                statuses = {name: await drone.ask() for name, drone in stage.drones.items()}
                shown = [claims_of(statuses[one], other) for one, other in (PAIR, PAIR[::-1])]
                if attempts >= 2 and all(shown):
                    break
                await asyncio.sleep(0.05)
        assert not stage.ledger.faults
        for claimed in shown:
            assert set(claimed) == {"MAV_CMD_COMPONENT_ARM_DISARM command_not_allowed"}
