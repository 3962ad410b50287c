"""What a daemon writes: for people on a terminal, JSON elsewhere; lost peers, and peers of another version."""

from __future__ import annotations

import json
import re
from datetime import datetime

from tests.daemon.frames import frame
from tests.daemon.harness import Stage
from tests.daemon.process import Status
from uavlinkd.core.constants import PROTOCOL_VERSION


async def test_lines_are_json_without_a_terminal(stage: Stage) -> None:
    """Into a pipe goes one JSON object a line, each with event, level, daemon and a time in UTC."""
    a, b = stage.pair()
    await stage.start(a, b)
    await a.stop()
    (started,) = a.events("daemon_started")
    assert (started["listen"], started["peers"]) == (a.config["listen"], ["drone1"])
    for line in map(json.loads, a.lines):
        assert re.fullmatch("[a-z][a-z_]*", line["event"])
        assert line["level"] in ("info", "warning")
        assert line["daemon"] == "drone0"
        offset = datetime.fromisoformat(line["timestamp"]).utcoffset()
        assert offset is not None
        assert not offset


async def test_a_peer_that_falls_silent_is_reported_lost_and_found(stage: Stage) -> None:
    """A peer whose power fails is lost in the log and the status within its time, and up again when it is back."""
    a, b = stage.pair(lost_after_s=0.5, probe_interval_s=0.2)
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    client = await stage.client()
    await b.kill()
    client.send(frame(1), into)
    lost = await a.until_logged("peer_lost")
    assert lost["peer"] == "drone1"
    assert lost["silent_s"] >= 0.5
    assert (await a.status())["peers"]["drone1"]["state"] == "lost"
    await stage.start(b)
    await a.until_linked()
    assert len(a.events("peer_up")) == 2


def remedies(status: Status, name: str) -> dict[str, str]:
    """What to do about a peer, by cause."""
    return {one["cause"]: one["remedy"] for one in status["findings"] if one["name"] == name}


async def test_both_name_the_older_side_if_versions_differ(stage: Stage) -> None:
    """The log and the status of both say which side to update, and that no key seems to be wrong."""
    older, newer = stage.pair()
    newer.protocol_version = PROTOCOL_VERSION + 1
    await stage.start(older, newer, linked=False)
    for daemon, peer in ((older, newer), (newer, older)):
        status = await daemon.until(lambda status, name=peer.name: "other_version" in remedies(status, name))  # type: ignore[misc]
        found = remedies(status, peer.name)
        assert found["other_version"].startswith(f"update uavlinkd at {older.name}")
        assert not {"wrong_key_here", "wrong_key_there"} & set(found)
        line = await daemon.until_logged("datagrams_dropped", reason="other_version")
        assert peer.address in line["last"]
