"""Real autopilots in their own simulators: ArduCopter, ArduRover (SITL), PX4 (SIH), each a process in its own folder.

The binaries are not part of this project: ``UAVLINKD_ARDUPILOT``, ``UAVLINKD_ROVER`` and ``UAVLINKD_PX4`` are their
paths. PX4's binary is in ``bin`` of its build folder, beside ``px4-mavlink``; ``etc`` of that folder has its start
script.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from time import monotonic
from typing import Self

from uavlinkd.lab.child_processes import end_with_parent, stop_child
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.lab.sim.vehicle import GeoPoint

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
"""What a newly built copter needs before its first flight, and a rover: its frame has the same number."""


class Firmware(StrEnum):
    """The autopilots that can be started."""

    ARDUPILOT = "ardupilot"
    PX4 = "px4"
    ROVER = "rover"

    @property
    def variable(self) -> str:
        """The environment variable for the path of its binary."""
        return f"UAVLINKD_{self.name}"


_MODELS = {Firmware.ARDUPILOT: "quad", Firmware.ROVER: "rover"}


class RealAutopilotError(Exception):
    """A real autopilot failed. The message is for the operator."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RealAutopilotSettings:
    """One autopilot.

    Args:
        binary: ``arducopter``, ``ardurover``, or ``bin/px4`` of a build.
        udp_port: a port of loopback. The autopilot sends its MAVLink there, and accepts MAVLink from there.
        instance: PX4 allows one process per instance on a machine, and derives ports from it.
        parameters: in addition to those of a new vehicle. ArduCopter stores changes, PX4 has these at each start.
        maintenance_port: a second port of loopback where ArduCopter sends MAVLink, as by USB. It accepts unsigned
            frames there, and at ``udp_port`` signed frames only, once it has a signing key.
    """

    firmware: Firmware
    binary: Path
    udp_port: int
    home: GeoPoint
    system_id: int = 1
    instance: int = 0
    parameters: Mapping[str, float] = field(default_factory=dict)
    maintenance_port: int | None = None


def binary_of(firmware: Firmware, environ: Mapping[str, str] = os.environ) -> Path | None:
    """The binary that the environment names; None if it names none.

    Raises:
        RealAutopilotError: it names a file that cannot be executed.
    """
    variable = firmware.variable
    text = environ.get(variable, "")
    if not text:
        return None
    if not os.access(text, os.X_OK) or Path(text).is_dir():
        raise RealAutopilotError(f"{variable}: {text} is not an executable file")
    return Path(text).resolve()


class RealAutopilot:
    """The process of one autopilot, as an asynchronous context. ``folder`` is created for its files.

    After :meth:`stop` it can be started again, with the files of its last run.
    """

    def __init__(self, settings: RealAutopilotSettings, folder: Path) -> None:
        self.settings = settings
        self.folder = folder
        self.log = folder / "autopilot.log"
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Start the process. It sends MAVLink soon after; its position estimate takes longer.

        Raises:
            RealAutopilotError: PX4's binary is not in a build folder, or PX4 ended or did not start in time.
                ArduCopter may end at any time after this: see :meth:`check`.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        is_px4 = self.settings.firmware is Firmware.PX4
        command, variables = self._px4() if is_px4 else (self._ardupilot(), {})
        with self.log.open("wb") as log:
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
            ports = ("-u", str(local_port), "-o", str(self.settings.udp_port), "-t", "127.0.0.1")
            # -x: files can be transferred
            await self._ask_px4("mavlink", "start", *ports, "-x", "-m", "onboard", "-r", str(_PX4_BYTES_PER_S))

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """Stop the process: first with a signal, then by killing it."""
        if self._process is not None:
            await stop_child(self._process, number, STOP_S)

    def check(self) -> None:
        """Raise RealAutopilotError with its last output if the process has ended."""
        if self._process is not None and self._process.returncode is not None:
            lines = "\n".join(self.log.read_text(errors="replace").splitlines()[-5:])
            output = f":\n{lines}" if lines else ", without output"
            raise RealAutopilotError(
                f"{self.settings.binary.name} ended with status {self._process.returncode}{output}"
            )

    async def __aenter__(self) -> Self:
        try:
            await self.start()
        except BaseException:
            await self.stop()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    def _ardupilot(self) -> Sequence[str]:
        defaults = self.folder / "defaults.parm"
        settings, home = self.settings, self.settings.home
        parameters = {**_COPTER_PARAMETERS, **settings.parameters}
        defaults.write_text("".join(f"{name} {value}\n" for name, value in parameters.items()))
        serial = dict.fromkeys((0, 1, 2, 5, 6, 7, 8), "none")
        ports = (settings.maintenance_port, settings.udp_port) if settings.maintenance_port else (settings.udp_port,)
        serial |= {number: f"udpclient:127.0.0.1:{port}" for number, port in enumerate(ports)}
        base, radio_in, simulator_in, simulator_out = free_ports(4)
        return (
            *(str(settings.binary), "--model", _MODELS[settings.firmware]),
            *("--speedup", "1", "--defaults", str(defaults)),
            *("--home", f"{home.latitude_deg},{home.longitude_deg},{home.altitude_m},0"),
            *("--sysid", str(settings.system_id)),
            *("--base-port", str(base), "--rc-in-port", str(radio_in)),
            *("--sim-port-in", str(simulator_in), "--sim-port-out", str(simulator_out)),
            *(text for number, to in serial.items() for text in (f"--serial{number}", to)),
        )

    def _px4(self) -> tuple[Sequence[str], Mapping[str, str]]:
        settings, home = self.settings, self.settings.home
        variables = {
            "PX4_SIM_MODEL": "sihsim_quadx",
            "PX4_SIMULATOR": "sihsim",
            "PX4_PARAM_MAV_SYS_ID": str(settings.system_id),
            "PX4_HOME_LAT": str(home.latitude_deg),
            "PX4_HOME_LON": str(home.longitude_deg),
            "PX4_HOME_ALT": str(home.altitude_m),
            "PX4_PARAM_COM_RC_IN_MODE": "4",  # there is no radio control
            "PX4_PARAM_SDLOG_MODE": "-1",  # no flight log on disk
            **{f"PX4_PARAM_{name}": str(value) for name, value in settings.parameters.items()},
        }
        etc = self.folder / "etc"
        shutil.copytree(self._px4_etc(), etc, dirs_exist_ok=True)
        # Its start script would derive the system ID from the instance.
        script = etc / "init.d-posix" / "rcS"
        script.write_text(re.sub(r"^param set MAV_SYS_ID .*$", "", script.read_text(), flags=re.MULTILINE))
        return (str(settings.binary), "-d", "-i", str(settings.instance), str(etc)), variables

    def _px4_etc(self) -> Path:
        """The folder ``etc`` of PX4's build folder."""
        binary = self.settings.binary
        for needed in ("../etc/init.d-posix/rcS", "px4-mavlink"):
            if not (binary.parent / needed).is_file():
                variable = self.settings.firmware.variable
                raise RealAutopilotError(f"{variable}: {binary} is not bin/px4 of a build folder (no {needed})")
        return binary.parent / "../etc"

    async def _ask_px4(self, command: str, *arguments: str) -> None:
        """Run a command of PX4's shell, as the link of that name beside its binary does."""
        client = self.settings.binary.parent / f"px4-{command}"
        process = await asyncio.create_subprocess_exec(
            *end_with_parent(str(client), "--instance", str(self.settings.instance), *arguments),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        output, _ = await process.communicate()
        if process.returncode:
            raise RealAutopilotError(
                f"px4-{command} {' '.join(arguments)}: {output.decode(errors='replace').strip()}"
            )

    async def _until_logged(self, text: str) -> None:
        until = monotonic() + START_S
        while text not in self.log.read_text(errors="replace"):
            self.check()
            if monotonic() >= until:
                raise RealAutopilotError(f"{self.settings.binary.name} did not start within {START_S:g} s")
            await asyncio.sleep(_LOOK_S)
