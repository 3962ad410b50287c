"""Keys are looked for in all that a daemon gives away. ``tests/config`` has keys in the wrong place of a file."""
# ruff: noqa: ASYNC240  (small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
from base64 import b64encode
from pathlib import Path

from tests.processes.frames import frame
from tests.processes.harness import Stage, secret_forms
from tests.processes.test_life import run
from uavlinkd.config import keys

KEY = b64encode(bytes(range(130, 162))).decode()
"""With + and / in it; so the other spelling of base64 differs."""


def reported(said: bytes, secrets: list[str]) -> list[str]:
    """Forms of secrets in some output, as bytes or as text."""
    leaked = [form for secret in secrets for form in secret_forms(secret) if form.encode() in said]
    return leaked + [secret for secret in secrets if keys.decode_key(secret)[:12] in said]


def test_search_finds_what_is_there() -> None:
    """In each form, whole or in part."""
    raw = keys.decode_key(KEY)
    for said in (KEY.encode(), raw, raw[:20], raw.hex().encode(), raw.hex().upper().encode(), repr(raw).encode()):
        assert reported(b"before " + said + b" after", [KEY])
    assert reported(KEY.replace("+", "-").replace("/", "_").rstrip("=").encode(), [KEY])
    assert not reported(b"nothing of it", [KEY])


async def test_nothing_that_a_daemon_gives_away_holds_a_key(stage: Stage) -> None:
    """Log at its most talkative, status, what /proc shows, and what its commands print."""
    a, b = stage.pair(confidential=True)
    for daemon in (a, b):
        daemon.config["log"] = {"level": "debug"}
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    client = await stage.client()
    client.send(frame(1), into)
    await b.until(lambda status: status["peers"]["drone0"]["frames_received"] == 1)
    output = []
    for daemon in (a, b):
        await daemon.status()
        output += [line.encode() for line in (*daemon.lines, *daemon.statuses)]
        output += [Path(f"/proc/{daemon.pid}/{name}").read_bytes() for name in ("cmdline", "environ")]
        for command in (["check"], ["status", "--json"], ["status"], ["reload"]):
            done = await asyncio.to_thread(run, daemon, *command)
            output.append(f"{done.stdout}{done.stderr}".encode())
    assert all(output), "something said nothing"
    assert reported(b"\n".join(output), stage.secrets) == []
