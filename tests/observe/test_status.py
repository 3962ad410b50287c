"""What a daemon tells about itself: plain values that any reader of JSON gets, and no secret."""

from __future__ import annotations

import json
from typing import Any

from tests.processes.conftest import stage
from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.waiting import PATIENCE_S

__all__ = ["stage"]


async def test_the_link_is_described(stage: Stage) -> None:
    """State, path, suite, mode, tag and ages, as they are, in strict JSON: no NaN, no infinity."""
    a, b = stage.pair()
    into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    await stage.start(a, b)
    one, other = await stage.client(), await stage.client()
    one.send(frame(1, 1), into_a)
    await b.until(lambda status: status["peers"]["drone0"]["frames_received"] == 1)
    other.send(frame(2, 2), into_b)
    await one.until_received(frame(2, 2))
    status = await a.until(lambda status: status["peers"]["drone1"]["round_trip_s"] is not None)
    peer = status["peers"]["drone1"]
    assert status["name"] == "drone0"
    assert status["public_key"] == a.public_key
    assert (peer["state"], peer["public_key"], peer["path"]) == ("up", b.public_key, b.address)
    session = peer["session"]
    assert (session["suite"], session["mode"], session["tag_bits"]) == ("x25519", "authenticated", 128)
    assert session["lost_in"] == 0
    assert peer["envelopes_missing"] == peer["envelopes_out_of_order"] == 0
    assert peer["cookies_taken"] == 0
    for key in ("handshakes_unanswered", "paths_unproven", "echoes_unanswered"):
        assert peer[key] >= 0  # a busy machine may answer late
    for key in ("round_trip_s", "last_received_s", "handshake_s"):
        assert 0 <= peer[key] < PATIENCE_S  # both ends may turn within one tick of the clock
    assert peer["handshakes"] >= 1
    for line in a.statuses:
        json.loads(line, parse_constant=refuse)


def refuse(constant: str) -> Any:
    """What JSON does not have."""
    raise AssertionError(constant)
