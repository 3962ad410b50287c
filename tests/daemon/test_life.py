"""How a daemon starts, fails to start, and ends."""
# ruff: noqa: ASYNC221, ASYNC240  (short commands and small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.daemon.harness import DaemonProcess, Stage, free_port, need


def run(daemon: DaemonProcess, command: str = "run") -> subprocess.CompletedProcess[str]:
    """A command on the configuration of a daemon, to its end."""
    return subprocess.run(
        [sys.executable, "-m", "uavlinkd", command, "--config", str(daemon.write_config())],
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_a_signal_ends_it_cleanly_and_the_peer_is_told(stage: Stage, number: signal.Signals) -> None:
    """SIGTERM and SIGINT give status 0, and the other end knows at once that the link is closed."""
    a, b = stage.pair()
    await stage.start(a, b)
    assert await a.stop(number) == 0
    told = await b.until_logged("peer_closed")
    assert told["peer"] == a.name
    status = await b.status()
    assert status["peers"][a.name]["state"] == "lost"
    assert not b.events("peer_lost"), "a goodbye is no loss"
    assert a.events()[-1]["event"] == "daemon_stopped"
    assert not (a.folder / "control.sock").exists()


async def test_it_starts_again_at_once_and_links_again(stage: Stage) -> None:
    """After a clean end the same configuration starts again, and the peers find each other."""
    a, b = stage.pair()
    await stage.start(a, b)
    await a.stop()
    await stage.start(a)
    await b.until_linked()


async def test_a_killed_daemon_leaves_nothing_in_the_way(stage: Stage) -> None:
    """The control socket of a daemon that was killed does not keep the next one from starting."""
    a, b = stage.pair()
    await stage.start(a, b)
    await a.kill()
    assert (a.folder / "control.sock").exists()
    await stage.start(a)


async def test_signals_during_a_flood_still_end_it(stage: Stage) -> None:
    """Datagrams that never stop do not keep a daemon from ending."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    program = await stage.program()
    sent = 0

    async def flood() -> None:
        nonlocal sent
        while True:
            for _ in range(50):
                program.send(b"\xfd" * 200, into)
                program.send(b"\x40" * 200, a.sockaddr)
            sent += 100
            await asyncio.sleep(0)

    flooding = asyncio.create_task(flood())
    try:
        await a.until(lambda status: bool(status["drops"]))
        before = sent
        assert await a.stop() == 0
        assert sent > before, "nothing was sent after the signal"
        assert not flooding.done()
    finally:
        flooding.cancel()
        await asyncio.gather(flooding, return_exceptions=True)


@pytest.mark.parametrize("taken", ["listen", "endpoint"])
async def test_a_port_in_use_is_told_in_one_line(stage: Stage, taken: str) -> None:
    """Where an address is taken, the daemon says which in one line and ends with status 1; the first is unharmed."""
    first, second, peer = stage.daemon("first"), stage.daemon("second"), stage.daemon("peer")
    for daemon in (first, second):
        daemon.add_peer(peer, [peer.address])
    host, port = first.add_endpoint("autopilot")
    if taken == "listen":
        second.config["listen"] = first.config["listen"]
        address = first.address
    else:
        second.add_endpoint("autopilot", f"udpin:{host}:{port}")
        address = f"{host}:{port}"
    await stage.start(first, linked=False)
    result = run(second)
    assert result.returncode == 1
    key = "listen" if taken == "listen" else "endpoint.url (autopilot)"
    (line,) = result.stderr.splitlines()
    assert line.startswith(
        f"{second.config_file}: {key}: cannot listen on {address}: Address already in use: end the"
    )
    assert result.stdout == ""
    await first.status()


async def test_two_daemons_do_not_share_a_control_socket(stage: Stage) -> None:
    """A second daemon does not take the control socket of one that runs: it says so and ends with status 1."""
    first, second, peer = stage.daemon("first"), stage.daemon("second"), stage.daemon("peer")
    for daemon in (first, second):
        daemon.add_peer(peer, [peer.address])
    second.config["control_socket"] = str(first.folder / "control.sock")
    await stage.start(first, linked=False)
    result = run(second)
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert "control.sock" in line
    assert (await first.status())["name"] == "first"


@pytest.mark.parametrize("command", ["run", "check"])
async def test_every_problem_of_a_file_is_listed_and_nothing_starts(stage: Stage, command: str) -> None:
    """Five mistakes in a file are five lines with file, key and remedy, and exit status 2."""
    a, b = stage.pair()
    a.config["listen"] = ["everywhere"]
    a.config["link"] = {"suites": ["dh1024"], "tag_bits": 17}
    a.config["colour"] = "green"
    a.config["endpoint"] = [{"name": "autopilot", "url": "udpin:127.0.0.1"}]
    result = run(a, command)
    assert result.returncode == 2
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    for key in ("listen", "link.suites", "link.tag_bits", "colour", "endpoint[0].url"):
        assert any(line.startswith(f"{a.config_file}: {key}") for line in lines), (key, lines)
    assert len(lines) == 5
    assert not (a.folder / "control.sock").exists()
    assert b.private_key not in result.stderr


async def test_a_key_that_others_can_read_is_refused(stage: Stage) -> None:
    """A private key file with mode 0644 keeps the daemon from starting."""
    a, _ = stage.pair()
    (a.folder / "daemon.key").chmod(0o644)
    result = run(a)
    assert result.returncode == 2
    assert "daemon.key" in result.stderr


async def test_check_shows_the_topology(stage: Stage) -> None:
    """A good file gives status 0, and says who, where and under which key; no secret is in it."""
    a, b = stage.pair()
    a.add_endpoint("autopilot")
    result = run(a, "check")
    assert result.returncode == 0
    for fact in (a.name, b.name, a.public_key, b.public_key[:8], a.address, b.address, "x25519"):
        assert fact in result.stdout
    for secret in stage.secrets:
        assert secret not in result.stdout + result.stderr


async def test_check_survives_a_reader_that_leaves(stage: Stage) -> None:
    """``uavlinkd check | head -1`` says nothing about a broken pipe."""
    a, _ = stage.pair()
    command = f"'{sys.executable}' -m uavlinkd check --config '{a.write_config()}' | true"
    result = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=20, check=False)
    assert result.stderr == ""


async def test_it_runs_without_a_control_socket(stage: Stage) -> None:
    """The control socket is there only where the file names one."""
    a, b = stage.pair()
    del a.config["control_socket"]
    await a.start()
    await stage.start(b)
    assert (await a.until_logged("peer_up"))["peer"] == b.name
    assert sorted(path.name for path in a.folder.iterdir()) == ["daemon.key", "daemon.toml", "drone1.psk"]


async def test_the_owner_alone_may_ask(stage: Stage) -> None:
    """The control socket has mode 0600."""
    a, _ = stage.pair()
    await stage.start(a, linked=False)
    assert (a.folder / "control.sock").stat().st_mode & 0o777 == 0o600


async def test_no_core_dump_holds_the_keys(stage: Stage) -> None:
    """A daemon that crashes leaves no core file."""
    a, _ = stage.pair()
    await stage.start(a, linked=False)
    limits = Path(f"/proc/{a.pid}/limits")
    need(limits.exists(), "Linux's /proc")
    (line,) = [each for each in limits.read_text().splitlines() if each.startswith("Max core file size")]
    assert line.split()[4:6] == ["0", "0"]


async def test_ports_are_those_of_the_file(stage: Stage) -> None:
    """What the log says at the start is what was configured."""
    a, b = stage.pair()
    a.config["listen"].append(f"127.0.0.1:{free_port()}")
    await stage.start(a, b)
    started = await a.until_logged("daemon_started")
    assert started["listen"] == a.config["listen"]
    assert started["peers"] == [b.name]
