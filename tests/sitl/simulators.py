"""The autopilots that fly, each a process in its own folder: ArduCopter (SITL), PX4 (SIH), and ``uavlinkd sim``.

Binaries of real ones are not part of this project: ``UAVLINKD_ARDUPILOT`` and ``UAVLINKD_PX4`` are their paths. PX4's
is in ``bin`` of its build folder, beside ``px4-mavlink``; ``etc`` of that folder has its start script.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from time import monotonic
from typing import Protocol

from tests.processes.udp import Sockaddr, shown
from uavlinkd.lab.child_processes import end_with_parent, stop_child
from uavlinkd.lab.sim.autopilot import HOME
from uavlinkd.lab.sim.loopback_ports import free_ports

FIRST_INSTANCE = 20 + 4 * (os.getpid() % 50)
"""PX4's instances are numbered for the whole machine. Other processes may fly some at the same time."""
START_S = 300.0
"""How long an autopilot may take to start: some seconds, and much more on a busy machine."""
STOP_S = 30.0
_LOOK_S = 0.1
_PX4_STARTED = "Startup script returned successfully"
_PX4_BYTES_PER_S = 1_000_000

_COPTER_PARAMETERS = {
    "FRAME_CLASS": 1,  # quadcopter
    "FRAME_TYPE": 0,
    # Offsets other than 0 mean that a sensor is calibrated: without them, ArduCopter refuses to arm.
    **{f"INS_ACC{number}OFFS_{axis}": 0.001 for number in ("", "2") for axis in "XYZ"},
    **{f"INS_ACC{number}SCAL_{axis}": 1.001 for number in ("", "2") for axis in "XYZ"},
    **{
        f"COMPASS_OFS{number}_{axis}": offset
        for number in ("", "2", "3")
        for axis, offset in zip("XYZ", (5, 13, -18), strict=True)
    },
    "FS_THR_ENABLE": 0,  # there is no radio control
}
"""What a newly built copter needs before its first flight."""


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
        )

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """End it by a signal."""
        if self._process is not None:
            await stop_child(self._process, number, STOP_S)


class Firmware(StrEnum):
    """The real autopilots."""

    ARDUPILOT = "ardupilot"
    PX4 = "px4"


class RealAutopilotError(Exception):
    """A real autopilot failed. The message is for the operator."""


def binary_of(firmware: Firmware) -> Path | None:
    """The binary that the environment names; None if it names none.

    Raises:
        RealAutopilotError: it names a file that cannot be executed.
    """
    variable = f"UAVLINKD_{firmware.name}"
    text = os.environ.get(variable, "")
    if not text:
        return None
    if not os.access(text, os.X_OK) or Path(text).is_dir():
        raise RealAutopilotError(f"{variable}: {text} is not an executable file")
    return Path(text).resolve()


class RealSimulator:
    """ArduPilot or PX4 in its simulator.

    ``parameters``: in addition to those of a new vehicle. ArduCopter stores changes, PX4 has these at each start.
    ``maintenance_port``: a second port of loopback where ArduCopter sends MAVLink, as by USB. It accepts unsigned
    frames there, and on its other link signed frames only, once it has a signing key.
    """

    def __init__(
        self,
        firmware: Firmware,
        system: int,
        folder: Path,
        *,
        parameters: Mapping[str, float],
        maintenance_port: int | None,
    ) -> None:
        binary = binary_of(firmware)
        assert binary is not None, f"UAVLINKD_{firmware.name} is not set"
        self.system = system
        self.folder = folder
        self._firmware = firmware
        self._binary = binary
        self._parameters = parameters
        self._maintenance_port = maintenance_port
        # Side by side, the vehicles stand 10 m apart.
        self._home = replace(HOME, latitude_deg=HOME.latitude_deg - 10 * (system - 1) / 111_319.5)
        self._log = folder / "autopilot.log"
        self._process: asyncio.subprocess.Process | None = None

    async def start(self, station: Sockaddr) -> None:
        """Start the process. It sends MAVLink soon after; its position estimate takes longer.

        Raises:
            RealAutopilotError: PX4's binary is not in a build folder, or PX4 ended or did not start in time.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        is_px4 = self._firmware is Firmware.PX4
        command, variables = self._px4() if is_px4 else (self._ardupilot(station[1]), {})
        with self._log.open("wb") as log:
            self._process = await asyncio.create_subprocess_exec(
                *end_with_parent(*command),
                cwd=self.folder,
                env={**os.environ, **variables},
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        if is_px4:
            await self._until_logged(_PX4_STARTED)
            # In place of the links that its start script opens, which have fixed ports.
            await self._ask_px4("mavlink", "stop-all")
            (local_port,) = free_ports(1)
            ports = ("-u", str(local_port), "-o", str(station[1]), "-t", "127.0.0.1")
            # -x: files can be transferred
            await self._ask_px4("mavlink", "start", *ports, "-x", "-m", "onboard", "-r", str(_PX4_BYTES_PER_S))

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """End it by a signal, or else kill it."""
        if self._process is not None:
            await stop_child(self._process, number, STOP_S)

    def _ardupilot(self, udp_port: int) -> Sequence[str]:
        defaults = self.folder / "defaults.parm"
        parameters = {**_COPTER_PARAMETERS, **self._parameters}
        defaults.write_text("".join(f"{name} {value}\n" for name, value in parameters.items()))
        serial = dict.fromkeys((0, 1, 2, 5, 6, 7, 8), "none")
        ports = (self._maintenance_port, udp_port) if self._maintenance_port else (udp_port,)
        serial |= {number: f"udpclient:127.0.0.1:{port}" for number, port in enumerate(ports)}
        base, radio_in, simulator_in, simulator_out = free_ports(4)
        return (
            *(str(self._binary), "--model", "quad", "--speedup", "1", "--defaults", str(defaults)),
            *("--home", f"{self._home.latitude_deg},{self._home.longitude_deg},{self._home.altitude_m},0"),
            *("--sysid", str(self.system)),
            *("--base-port", str(base), "--rc-in-port", str(radio_in)),
            *("--sim-port-in", str(simulator_in), "--sim-port-out", str(simulator_out)),
            *(text for number, to in serial.items() for text in (f"--serial{number}", to)),
        )

    # PX4.

    @property
    def _instance(self) -> str:
        return str(FIRST_INSTANCE + self.system)

    def _px4(self) -> tuple[Sequence[str], Mapping[str, str]]:
        variables = {
            "PX4_SIM_MODEL": "sihsim_quadx",
            "PX4_SIMULATOR": "sihsim",
            "PX4_PARAM_MAV_SYS_ID": str(self.system),
            "PX4_HOME_LAT": str(self._home.latitude_deg),
            "PX4_HOME_LON": str(self._home.longitude_deg),
            "PX4_HOME_ALT": str(self._home.altitude_m),
            "PX4_PARAM_COM_RC_IN_MODE": "4",  # there is no radio control
            "PX4_PARAM_SDLOG_MODE": "-1",  # no flight log on disk
            **{f"PX4_PARAM_{name}": str(value) for name, value in self._parameters.items()},
        }
        for needed in ("../etc/init.d-posix/rcS", "px4-mavlink"):
            if not (self._binary.parent / needed).is_file():
                raise RealAutopilotError(f"UAVLINKD_PX4: {self._binary} is not bin/px4 of a build (no {needed})")
        etc = self.folder / "etc"
        shutil.copytree(self._binary.parent / "../etc", etc, dirs_exist_ok=True)
        # Its start script would derive the system ID from the instance.
        script = etc / "init.d-posix" / "rcS"
        script.write_text(re.sub(r"^param set MAV_SYS_ID .*$", "", script.read_text(), flags=re.MULTILINE))
        return (str(self._binary), "-d", "-i", self._instance, str(etc)), variables

    async def _ask_px4(self, command: str, *arguments: str) -> None:
        """Run a command of PX4's shell, as the link of that name beside its binary does."""
        process = await asyncio.create_subprocess_exec(
            *end_with_parent(str(self._binary.parent / f"px4-{command}"), "--instance", self._instance, *arguments),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        output, _ = await process.communicate()
        if process.returncode:
            said = output.decode(errors="replace").strip()
            raise RealAutopilotError(f"px4-{command} {' '.join(arguments)}: {said}")

    async def _until_logged(self, text: str) -> None:
        until = monotonic() + START_S
        while text not in (said := self._log.read_text(errors="replace")):
            assert self._process is not None
            if self._process.returncode is not None or monotonic() >= until:
                last = "\n".join(said.splitlines()[-5:])
                raise RealAutopilotError(f"{self._binary.name} did not start; its last output:\n{last}")
            await asyncio.sleep(_LOOK_S)
