"""What a daemon writes: for people on a terminal, JSON elsewhere, and no secret in either."""

from __future__ import annotations

import json
import re
from datetime import datetime

from tests.daemon.frames import frame
from tests.daemon.harness import Stage


async def test_lines_are_json_without_a_terminal(stage: Stage) -> None:
    """Into a pipe goes one JSON object a line, each with event, level, daemon and a time in UTC."""
    a, b = stage.pair()
    await stage.start(a, b)
    await a.stop()
    parsed = [json.loads(line) for line in a.lines]
    (started,) = a.events("daemon_started")
    assert (started["listen"], started["peers"]) == (a.config["listen"], ["drone1"])
    for line in parsed:
        assert re.fullmatch("[a-z][a-z_]*", line["event"])
        assert line["level"] in ("info", "warning")
        assert line["daemon"] == "drone0"
        offset = datetime.fromisoformat(line["timestamp"]).utcoffset()
        assert offset is not None
        assert not offset


async def test_a_terminal_gets_lines_for_people(stage: Stage) -> None:
    """On a terminal the lines are coloured text and no JSON."""
    a, b = stage.pair()
    await a.start(on_terminal=True)
    await stage.start(b)
    await a.stop()
    text = "\n".join(a.lines)
    assert "daemon_started" in text
    assert "\x1b[" in text
    assert not a.events()


async def test_a_peer_that_falls_silent_is_reported_lost_and_found(stage: Stage) -> None:
    """A peer whose power fails is lost in the log and the status within its time, and up again when it is back."""
    a, b = stage.pair(echo_after_s=0.1, handshake_after_s=0.2, lost_after_s=0.5, probe_interval_s=0.2)
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


async def test_a_wrong_psk_is_explained(stage: Stage) -> None:
    """Two daemons with different PSKs do not link, and the log says what that may be; the PSK is not in it."""
    a, b = stage.daemon("drone0"), stage.daemon("drone1")
    a.add_peer(b, [b.address], stage.psk())
    b.add_peer(a, [a.address], stage.psk())
    await stage.start(a, b, linked=False)
    reported = await a.until_logged("datagrams_dropped", reason="bad_handshake")
    assert "PSK" in reported["meaning"]
    assert (await a.status())["peers"]["drone1"]["state"] == "waiting"
