"""What a daemon writes: for people on a terminal, JSON elsewhere, and no secret in either."""

from __future__ import annotations

import json
import re
from datetime import datetime

import pytest

from tests.daemon.harness import Stage, frame


async def test_lines_are_json_where_nobody_looks(stage: Stage) -> None:
    """Into a pipe goes one JSON object a line, each with event, level, daemon and a time in UTC."""
    a, b = stage.pair()
    await stage.start(a, b)
    await a.stop()
    parsed = [json.loads(line) for line in a.lines]
    assert [each["event"] for each in parsed if each["event"] == "daemon_started"] == ["daemon_started"]
    for each in parsed:
        assert re.fullmatch("[a-z][a-z_]*", each["event"])
        assert each["level"] in ("info", "warning")
        assert each["daemon"] == "drone0"
        offset = datetime.fromisoformat(each["timestamp"]).utcoffset()
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


@pytest.mark.parametrize("form", ["json", "console"])
async def test_the_form_can_be_chosen(stage: Stage, form: str) -> None:
    """``format`` decides, whatever standard error is; console lines in a file have no colours."""
    a, b = stage.pair()
    a.config["log"] = {"format": form}
    await a.start(on_terminal=form == "json")
    await stage.start(b)
    await a.stop()
    assert bool(a.events("daemon_started")) == (form == "json")
    assert "\x1b[" not in "\n".join(a.lines)


async def test_the_level_is_kept(stage: Stage) -> None:
    """At ``error`` an uneventful life writes nothing."""
    a, b = stage.pair()
    a.config["log"] = {"level": "error"}
    await stage.start(a, b)
    await a.stop()
    assert a.lines == []


async def test_a_peer_that_falls_silent_is_reported_lost_and_found(stage: Stage) -> None:
    """A peer whose power fails is lost in the log and the status within its time, and up again when it is back."""
    a, b = stage.pair(echo_after_s=0.1, handshake_after_s=0.2, lost_after_s=0.5, probe_interval_s=0.2)
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    program = await stage.program()
    await b.kill()
    program.send(frame(1), into)
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
    told = await a.until_logged("datagrams_dropped", reason="bad_handshake")
    assert "PSK" in told["meaning"]
    assert (await a.status())["peers"]["drone1"]["state"] == "waiting"


async def test_a_suite_that_the_other_side_does_not_take_is_explained(stage: Stage) -> None:
    """Suites that have nothing in common make no link, and the side that refuses says why."""
    a, b = stage.pair()
    a.config["link"]["suites"] = ["ffdhe2048"]
    b.config["link"]["suites"] = ["mlkem768"]
    await stage.start(a, b, linked=False)
    assert "suite" in (await b.until_logged("datagrams_dropped", reason="suite_not_accepted"))["meaning"]
