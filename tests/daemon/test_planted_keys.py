"""Keys are planted wherever an operator may put them by mistake, and looked for in all that a daemon gives away."""
# ruff: noqa: ASYNC240  (small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import subprocess
import sys
import urllib.request
from base64 import b64encode
from pathlib import Path

import pytest

from tests.daemon.frames import frame
from tests.daemon.harness import Stage, secret_forms
from tests.daemon.process import DaemonProcess
from tests.waiting import PATIENCE_S
from uavlinkd.config import keys
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port

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


@pytest.mark.long
async def test_nothing_that_a_daemon_gives_away_holds_a_key(stage: Stage) -> None:
    """Log at its most talkative, status, metrics, recordings, what /proc shows, and what its commands print."""
    a, b = stage.pair(confidential=True)
    for daemon in (a, b):
        daemon.config["log"] = {"level": "debug"}
        daemon.config["recording"] = {"folder": "recordings", "min_free_bytes": 100_000}
        daemon.config["metrics"] = {"listen": f"127.0.0.1:{free_port()}"}
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    client = await stage.client()
    client.send(frame(1), into)
    for daemon in (a, b):
        await daemon.until(lambda status: status["recording"]["frames"] == 1)
    output = []
    for daemon in (a, b):
        await daemon.status()
        output += [line.encode() for line in (*daemon.lines, *daemon.statuses)]
        output += [Path(f"/proc/{daemon.pid}/{name}").read_bytes() for name in ("cmdline", "environ")]
        url = f"http://{daemon.config['metrics']['listen']}/metrics"
        output.append(await asyncio.to_thread(lambda url=url: urllib.request.urlopen(url).read()))  # type: ignore[misc]
        output += [path.read_bytes() for path in (daemon.folder / "recordings").iterdir()]
        for command in (["check"], ["status", "--json"], ["status"], ["peer", "list"], ["reload"]):
            output.append(await asyncio.to_thread(run, daemon, *command))
    assert all(output), "something said nothing"
    assert reported(b"\n".join(output), stage.secrets) == []


def run(daemon: DaemonProcess, *command: str) -> bytes:
    """What a command on a daemon's configuration prints; a space, if nothing."""
    line = [sys.executable, "-m", "uavlinkd", *command, "--config", str(daemon.config_file)]
    done = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=PATIENCE_S, check=False)
    return done.stdout + b" "


GOOD = """\
name = "drone0"
private_key_file = "daemon.key"
listen = ["127.0.0.1:5790"]
control_socket = "control.sock"
[log]
level = "info"
[[endpoint]]
name = "autopilot"
url = "udpin:127.0.0.1:14550"
[[peer]]
name = "drone1"
public_key = "PUBLIC"
addresses = ["127.0.0.1:5791"]
psk_file = "drone1.psk"
role = "all"
system_ids = "all"
"""
MISTAKES = {
    "as the name": ('name = "drone0"', f'name = "{KEY}"'),
    "as the file": ('"daemon.key"', f'"{KEY}"'),
    "as the file, cut": ('"daemon.key"', f'"{KEY[:-1]}"'),
    "in another field": ('private_key_file = "daemon.key"', f'private_key = "{KEY}"'),
    "as a field": ('private_key_file = "daemon.key"', f'"{KEY}" = "daemon.key"'),
    "as a field with a value of its own": ('private_key_file = "daemon.key"', f"{KEY[:-1].replace('+', 'a')} = 1"),
    "bare": ('"daemon.key"', KEY),
    "on a line of its own": ('private_key_file = "daemon.key"', KEY),
    "in an open quote": ('"daemon.key"', f'"{KEY}'),
    "as an address": ('["127.0.0.1:5790"]', f'["{KEY}"]'),
    "as an address with a port": ('["127.0.0.1:5791"]', f'["{KEY}:5791"]'),
    "as a level": ('level = "info"', f'level = "{KEY}"'),
    "as a URL": ('"udpin:127.0.0.1:14550"', f'"{KEY}"'),
    "in a URL": ('"udpin:127.0.0.1:14550"', f'"udpin:{KEY}:14550"'),
    "as a device": ('"udpin:127.0.0.1:14550"', f'"serial:{KEY}:57600"'),
    "as a device's speed": ('"udpin:127.0.0.1:14550"', f'"serial:/dev/ttyS0:{KEY}"'),
    "as the peer's name": ('"drone1"\npublic', f'"{KEY}"\npublic'),
    "as the PSK's file": ('"drone1.psk"', f'"{KEY}"'),
    "as a public key with more": ('"PUBLIC"', f'"{KEY} drone1"'),
    "as a role": ("psk_file", f'role = "{KEY}"\npsk_file'),
    "as a message": ("psk_file", f'deny_in = ["{KEY}"]\npsk_file'),
    "as a message's rate": ("psk_file", f'rate_in = {{ "{KEY}" = 5 }}\npsk_file'),
    "as a suite": ("psk_file", f'suites = ["{KEY}"]\npsk_file'),
    "as a section": ("[log]", f'["{KEY}"]\nx = 1\n[log]'),
    "as the socket": ('"control.sock"', f'"{KEY}"'),
}


@pytest.mark.long
@pytest.mark.parametrize("command", ["check", "run"])
def test_a_key_in_the_wrong_place_is_not_repeated(command: str, tmp_path: Path) -> None:
    """Both commands report the problem, and never the planted key."""
    keys.write_secret_file(tmp_path / "daemon.key", keys.generate_private_key())
    keys.write_secret_file(tmp_path / "drone1.psk", keys.generate_psk())
    good = GOOD.replace("PUBLIC", keys.public_key_text(keys.generate_private_key()))
    running = {}
    for number, (where, (old, new)) in enumerate(MISTAKES.items()):
        path = tmp_path / f"{number}.toml"
        text = good.replace("PUBLIC", "") if old == '"PUBLIC"' else good
        if old == '"PUBLIC"':
            text = GOOD
        assert old in text, where
        path.write_text(text.replace(old, new, 1))
        if command == "check" or number % 5 == 0:  # they read the file by the same code
            line = [sys.executable, "-m", "uavlinkd", command, "--config", str(path)]
            running[where] = subprocess.Popen(
                end_with_parent(*line), stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )
        if len(running) % 3 == 0:
            for process in running.values():
                process.wait(30)
    for where, process in running.items():
        said, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 2, (where, said)
        assert said.strip(), where
        assert reported(said, [KEY]) == [], (where, said)
