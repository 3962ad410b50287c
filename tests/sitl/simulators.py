"""The autopilots that fly: real ones where the environment names their binaries, and our own for comparison."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from tests.processes.udp import Sockaddr, shown
from tests.sitl.real_autopilot import Firmware, RealAutopilot, RealAutopilotSettings, binary_of
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.autopilot import HOME

FIRST_INSTANCE = 20 + 4 * (os.getpid() % 50)
"""PX4's instances are numbered for the whole machine. Other processes may fly some at the same time."""


class Simulator(Protocol):
    """An autopilot in its simulator. It keeps its files, so that a restart is like that of a real one."""

    system: int
    folder: Path
    """For its parameters, missions, logs and files."""

    async def start(self, station: Sockaddr) -> None:
        """Start it. It sends its MAVLink to ``station``."""

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """End it by a signal."""


class OwnSimulator:
    """``uavlinkd sim`` as a process."""

    def __init__(self, system: int, folder: Path) -> None:
        self.system = system
        self.folder = folder
        self._process: asyncio.subprocess.Process | None = None

    async def start(self, station: Sockaddr) -> None:
        """Start it, with its parameters and missions as new."""
        self._process = await asyncio.create_subprocess_exec(
            *end_with_parent(sys.executable, "-m", "uavlinkd", "sim", "--url", f"udpout:{shown(station)}"),
            *("--system-id", str(self.system)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
            env=dict(os.environ),
        )

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """End it by a signal."""
        if self._process is not None and self._process.returncode is None:
            self._process.send_signal(number)
            await self._process.wait()


class RealSimulator:
    """ArduPilot or PX4 in its simulator."""

    def __init__(
        self,
        firmware: Firmware,
        system: int,
        folder: Path,
        *,
        parameters: Mapping[str, float] | None = None,
        maintenance_port: int | None = None,
    ) -> None:
        binary = binary_of(firmware)
        assert binary is not None, f"UAVLINKD_{firmware.name} is not set"
        self.system = system
        self.folder = folder
        self._firmware = firmware
        self._binary = binary
        self._parameters = dict(parameters or {})
        self._maintenance_port = maintenance_port
        self._autopilot: RealAutopilot | None = None

    async def start(self, station: Sockaddr) -> None:
        """Start it. Side by side, the vehicles stand 10 m apart."""
        if self._autopilot is None:
            home = replace(HOME, latitude_deg=HOME.latitude_deg - 10 * (self.system - 1) / 111_319.5)
            settings = RealAutopilotSettings(
                firmware=self._firmware,
                binary=self._binary,
                udp_port=station[1],
                home=home,
                system_id=self.system,
                instance=FIRST_INSTANCE + self.system,
                parameters=self._parameters,
                maintenance_port=self._maintenance_port,
            )
            self._autopilot = RealAutopilot(settings, self.folder)
        await self._autopilot.start()

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """End it by a signal."""
        if self._autopilot is not None:
            await self._autopilot.stop(number)
