"""One flight, as ground stations by others fly it: connect, parameters, mission, up and down.

Each scenario needs only a URL at which a vehicle answers, so it runs against the simulated autopilot itself and
through daemons between the two alike. ``UAVLINKD_CLIENT_PYTHON`` names another interpreter for the clients, where
they are not installed beside the project.
"""

from __future__ import annotations

import asyncio
import functools
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests import waiting
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.flight import Flight

TIMEOUT_S = 600.0
PYTHON = os.environ.get("UAVLINKD_CLIENT_PYTHON", sys.executable)
CLIENTS = Path(__file__).with_name("clients.py")


@dataclass(frozen=True, slots=True)
class Seen:
    """The observations of a ground station."""

    system_id: int
    parameters: dict[str, float]
    parameters_set: list[float]  # WPNAV_SPEED_UP and LAND_SPEED, set to 500 and 200 and read back
    plan: list[Any]  # the mission as read back
    top_m: float


def plan_sent() -> list[Any]:
    """The mission that every scenario uploads, in the form of ``Seen.plan``."""
    text = CLIENTS.read_text()
    names: dict[str, Any] = {"__name__": "clients"}
    exec(compile(text, CLIENTS, "exec"), names)  # a script, not a module of this package
    return list(json.loads(json.dumps(names["PLAN"])))


@functools.cache
def missing(module: str) -> str | None:
    """The reason why a client cannot run; None if it can."""
    result = subprocess.run([PYTHON, "-c", f"import {module}"], capture_output=True, check=False, text=True)
    return None if result.returncode == 0 else f"{module} is not importable: {result.stderr.strip().splitlines()[-1]}"


def need(module: str) -> None:
    """Skip the test, with the reason, if a client is not installed; in CI it fails (tests/conftest.py)."""
    reason = missing(module)
    if reason:
        pytest.skip(reason)


def check(seen: Seen, *, system_id: int, parameters: dict[str, float]) -> None:
    """The station received all messages, and its changes took effect."""
    assert seen.system_id == system_id
    assert seen.parameters == pytest.approx(parameters, rel=1e-5, abs=1e-6)  # MAVProxy prints six decimals
    assert seen.parameters_set == [500, 200]
    assert seen.plan == plan_sent()
    assert seen.top_m > 2.6


def check_flown(flight: Flight) -> None:
    """The vehicle did all that, once."""
    events = flight.autopilot.events
    wanted = ("mission_received", "armed", "takeoff_started", "landed", "disarmed")
    assert {name: events[name] for name in wanted} == dict.fromkeys(wanted, 1)
    assert [flight.autopilot.parameters[name] for name in ("WPNAV_SPEED_UP", "LAND_SPEED")] == [500, 200]
    assert len(flight.autopilot.missions.plan) == len(plan_sent())
    assert flight.link.split.garbage_bytes == 0


async def fly_with_mavsdk(url: str) -> Seen:
    """MAVSDK's own library flies the vehicle."""
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(PYTHON, str(CLIENTS), url), stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    try:
        output, _ = await asyncio.wait_for(process.communicate(), TIMEOUT_S)
    finally:
        await _end(process)
    text = output.decode(errors="replace")
    assert process.returncode == 0, text
    facts = json.loads(text.splitlines()[-1])
    return Seen(facts["system_id"], facts["parameters"], facts["set"], facts["plan"], facts["top_m"])


class Terminal:
    """A process with input and output."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self.text = ""

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line.encode() + b"\n")

    async def see(self, wanted: str, timeout_s: float = 30.0) -> None:
        """Read until a text appears after the output so far."""
        if not await self._saw(wanted, timeout_s):
            raise AssertionError(f"{wanted!r} did not come:\n{self.text}")

    async def ask(self, line: str, wanted: str, times: int = 20) -> None:
        """Type a line every second until its answer is the wanted one."""
        for _ in range(times):
            self.type(line)
            if await self._saw(wanted, 1.0):
                return
        raise AssertionError(f"{line!r} was not answered by {wanted!r}:\n{self.text}")

    async def _saw(self, wanted: str, timeout_s: float) -> bool:
        assert self._process.stdout is not None
        seen = ""
        try:
            async with asyncio.timeout(timeout_s):
                while wanted not in seen:
                    got = (await self._process.stdout.read(1)).decode(errors="replace")
                    assert got, f"it ended before {wanted!r}:\n{self.text}"
                    seen += got
                    self.text += got
        except TimeoutError:
            return False
        return True


async def fly_with_mavproxy(url: str, folder: Path, flight: Flight) -> Seen:
    """MAVProxy flies the vehicle, typed at as by a pilot. It prints no altitude, so the flight itself tells it."""
    sent, back = folder / "sent.txt", folder / "back.txt"
    sent.write_text(_as_mavproxy_file(plan_sent()))
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(PYTHON, "-u", "-m", "MAVProxy.mavproxy", f"--master={url}", f"--state-basedir={folder}"),
        *(f"--logfile={folder / 'flight.tlog'}", "--default-modules=log,wp,ftp,param,arm,mode,misc,cmdlong"),
        cwd=folder,
        env={**os.environ, "HOME": str(folder), "PYTHONUNBUFFERED": "1"},
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    terminal = Terminal(process)
    try:
        await terminal.see("Detected vehicle ")
        await terminal.see(" on link")
        system_id = int(terminal.text.rsplit("Detected vehicle ", 1)[1].split(":")[0])
        await terminal.see(" parameters to ")
        await terminal.see(".parm\n")
        saved = Path(terminal.text.rsplit(" parameters to ", 1)[1].strip())
        parameters = _of_parameter_file(saved)
        terminal.type("param set WPNAV_SPEED_UP 500")
        terminal.type("param set LAND_SPEED 200")
        await terminal.ask("param fetch WPNAV_SPEED_UP", "WPNAV_SPEED_UP = 500.0")
        await terminal.ask("param fetch LAND_SPEED", "LAND_SPEED = 200.0")
        terminal.type(f"wp load {sent}")
        await terminal.see("MISSION_ACK")
        terminal.type(f"wp save {back}")
        await terminal.see(f"Saved {len(plan_sent())} waypoints")
        terminal.type("mode guided")
        await terminal.see("Mode GUIDED")
        terminal.type("arm throttle")
        await terminal.see("ARMED")
        terminal.type("takeoff 3")
        await terminal.see("NAV_TAKEOFF: ACCEPTED")
        await waiting.until(lambda: flight.autopilot.vehicle.altitude_m > 2.7)
        top_m = flight.autopilot.vehicle.altitude_m
        terminal.type("mode land")
        await terminal.see("DISARMED")
        plan = _of_mavproxy_file(back.read_text())
    finally:
        await _end(process)
    return Seen(system_id, parameters, [500.0, 200.0], plan, top_m)


def _of_parameter_file(path: Path) -> dict[str, float]:
    return {name: float(value) for name, value in map(str.split, path.read_text().splitlines())}


def _as_mavproxy_file(plan: list[Any]) -> str:
    rows = ["QGC WPL 110"]
    for sequence, (command, frame, four, x, y, z) in enumerate(plan):
        place = f"{x / 1e7:.8f}\t{y / 1e7:.8f}\t{z:.6f}"
        numbers = "\t".join(f"{value:.6f}" for value in four)
        rows.append(f"{sequence}\t{int(sequence == 0)}\t{frame}\t{command}\t{numbers}\t{place}\t1")
    return "\n".join(rows) + "\n"


def _of_mavproxy_file(text: str) -> list[Any]:
    plan = []
    for row in text.splitlines()[1:]:
        fields = row.split()
        x, y = (round(float(value) * 1e7) for value in fields[8:10])
        plan.append(
            [int(fields[3]), int(fields[2]), [float(value) for value in fields[4:8]], x, y, float(fields[10])]
        )
    return plan


async def _end(process: asyncio.subprocess.Process) -> None:
    """Stop a process of this module, and close its pipes."""
    if process.returncode is None:
        process.kill()
    await process.communicate()
