"""The demo's judgement, and its screen."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tests.ops.schema import golden
from uavlinkd.lab.demo.run import attacks_of
from uavlinkd.lab.demo.screen import AttackResult, Summary, render
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.ops import DEMO_SCHEMA
from uavlinkd.protocol.drops import DropReason

ATTACKED: dict[str, Any] = {"attacks": [AttackResult("drop", 9)]}


@pytest.mark.parametrize(
    ("counts", "more", "is_good"),
    [
        ((10, 10, 0), {}, True),
        ((10, 9, 0), {}, False),
        ((10, 11, 0), {}, False),
        ((10, 10, 1), {}, False),
        ((0, 0, 0), {}, False),
        ((10, 9, 0), ATTACKED, True),
        ((10, 9, 1), ATTACKED, False),
        ((10, 9, 0), {**ATTACKED, "is_recovered": False}, False),
        ((10, 9, 0), {"attacks": [AttackResult("drop")]}, False),
    ],
)
def test_good_means_that_nothing_false_arrived(
    counts: tuple[int, int, int], more: dict[str, Any], is_good: bool
) -> None:
    """Without an attack, no frame is lost either. An attack must have had a target, and the link recovers."""
    assert Summary(2.0, *counts, 3, {"bad_tag": 4}, 0.25, **more).is_good is is_good


def test_json_has_the_declared_names() -> None:
    """With and without attacks."""
    drops = {"bad_tag": 4}
    calm = Summary(2.0, 10, 10, 0, 3, drops, 0.2)
    attacked = Summary(2.0, 10, 10, 0, 3, drops, None, [AttackResult("drop", 9, drops)])
    facts = [json.loads(summary.to_json()) for summary in (calm, attacked)]
    names = golden.names_of(*facts, counts={"drops": 1, "attacks[].noticed": 1})
    assert {one["schema"] for one in facts} == {DEMO_SCHEMA}
    assert golden.differences("demo", DEMO_SCHEMA, golden.load("demo"), names) == []


def test_the_screen_fits_a_small_terminal(tmp_path: Path) -> None:
    """80 columns and 24 lines, also when every counter has grown: rich cuts off the lines below."""
    drops = {reason.value: 12345 for reason in DropReason}
    session = {"suite": "ffdhe2048", "generation": 1234}
    peer = {
        "state": "up",
        "session": session,
        "round_trip_s": 12.34567,
        "handshake_s": 123.4,
        "envelopes_sent": 10**7,
    }
    drones = [DroneProcess(name, tmp_path / name, 1, 2) for name in ("drone0", "drone1")]
    for drone in drones:
        drone.status = {"peers": {"other": {**peer, "envelopes_received": 10**7}}}
    longest = max((str(spec) for spec in attacks_of("all")), key=len)
    results = [AttackResult(longest, 123456, drops) for _ in range(9)]
    file = io.StringIO()
    counts = {"sent": 1234567, "delivered": 1234567, "altered": 0}
    Console(file=file, width=80).print(render(drones, counts, drops, 123.4, results))
    lines = file.getvalue().splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert "123.4 s left" in lines[-1], "nothing is cut off"
    for text in ("link", "1,234,567 delivered", "dropped", longest, "123,456"):
        assert any(text in line for line in lines), text
