"""Autopilots under test, each with two links: the project's simulator, ArduCopter in SITL, and PX4 in SIH."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic, sleep
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.roles_links import Link, LinkClosedError, connected, listening, speaking
from tests.sitl.roles_station import Station, StationError
from tests.waiting import PATIENCE_S
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.autopilot import HOME
from uavlinkd.lab.sim.loopback_ports import free_port, free_ports

STATION: Final = (255, 190)
HEIGHT_M: Final = 20.0
STOP_S: Final = 20.0
SPEEDUP: Final = 5
"""Of the autopilots' simulators, beyond real time."""
_GUIDED: Final = 4  # ArduCopter's number of the mode
_PX4_HOLD: Final = 0x03040000  # PX4_CUSTOM_MAIN_MODE_AUTO, PX4_CUSTOM_SUB_MODE_AUTO_LOITER
_COPTER_PARAMETERS: Final[Mapping[str, float]] = {
    "FRAME_CLASS": 1,
    # Offsets other than 0 mean that a sensor is calibrated: without them, ArduCopter refuses to arm.
    **{f"INS_ACC{number}OFFS_{axis}": 0.001 for number in ("", "2") for axis in "XYZ"},
    **{f"INS_ACC{number}SCAL_{axis}": 1.001 for number in ("", "2") for axis in "XYZ"},
    **{f"COMPASS_OFS{number}_{axis}": 5 for number in ("", "2", "3") for axis in "XYZ"},
    "FS_THR_ENABLE": 0,  # there is no radio control
    "DISARM_DELAY": 0,
    "FS_GCS_ENABLE": 1,
    "FS_GCS_TIMEOUT": 30,  # its time passes faster: a busy station must not seem lost
    # SITL ends itself where a number that is not finite becomes an integer. A flight controller goes on.
    "SIM_FLOAT_EXCEPT": 0,
    **{f"SR{port}_{group}": 4 for port in (0, 1) for group in ("POSITION", "EXTRA1", "EXTRA2", "EXT_STAT")},
    **{f"MAV{port}_{group}": 4 for port in (1, 2) for group in ("POSITION", "EXTRA1", "EXTRA2", "EXT_STAT")},
}


class Vehicle(ABC):
    """The process of one autopilot, as a context. ``folder`` is for its files."""

    settle_s = 30.0
    """Until its estimate is steady, in seconds of its own time: home and origin move before."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._process: subprocess.Popen[bytes]
        self._links: list[Link] = []

    def __enter__(self) -> Station:
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            own, attacker = self._open()
            self._links += [own, attacker]
            station = Station(own, attacker)
            station.check = self.check
            station.until(lambda: own.is_known and attacker.is_known, "both links")
            station.until(lambda: "GLOBAL_POSITION_INT" in station.seen.latest, "a position")
        except BaseException:
            self._end()
            raise
        return station

    def __exit__(self, *_: object) -> None:
        self._end()

    def check(self) -> None:
        """Raise if the autopilot's process has ended.

        Raises:
            LinkClosedError: it has.
        """
        if self._process.poll() is not None:
            raise LinkClosedError

    def why_ended(self) -> str:
        """The status of the process that ended, and its last output."""
        lines = (self.folder / "autopilot.log").read_text(errors="replace").splitlines()
        last = [line for line in lines if line.strip()][-8:]
        return f"the autopilot ended with status {self._process.wait(STOP_S)}: {' | '.join(last)}"

    @abstractmethod
    def _open(self) -> tuple[Link, Link]:
        """Start the autopilot, and open the station's link and the attacker's."""

    def take_off(self, station: Station) -> None:
        """Take off, here in the mode GUIDED, and hold the position."""
        _take_off_guided(station)

    def _run(self, *command: str, variables: Mapping[str, str] | None = None) -> None:
        with (self.folder / "autopilot.log").open("wb") as log:
            self._process = subprocess.Popen(
                end_with_parent(*command),
                cwd=self.folder,
                env={**os.environ, **(variables or {})},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def _end(self) -> None:
        for link in self._links:
            link.close()
        self._process.terminate()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class SimulatedVehicle(Vehicle):
    """The project's own simulator. Both links share its one port."""

    settle_s = 0.0

    def _open(self) -> tuple[Link, Link]:
        port = free_port()
        self._run(sys.executable, "-m", "uavlinkd", "sim", "--url", f"udpin:127.0.0.1:{port}")
        return speaking(port, STATION), speaking(port, STATION)


class ArduCopter(Vehicle):
    """ArduCopter in its own simulator."""

    def __init__(self, folder: Path, binary: Path) -> None:
        super().__init__(folder)
        self._binary = binary

    def _open(self) -> tuple[Link, Link]:
        defaults = self.folder / "defaults.parm"
        defaults.write_text("".join(f"{name} {value}\n" for name, value in _COPTER_PARAMETERS.items()))
        base, radio_in, simulator_in, simulator_out, own, attacker = free_ports(6)
        self._run(
            *(str(self._binary), "--model", "quad", "--speedup", str(SPEEDUP), "--defaults", str(defaults)),
            *("--home", f"{HOME.latitude_deg},{HOME.longitude_deg},{HOME.altitude_m},0"),
            *("--base-port", str(base), "--rc-in-port", str(radio_in)),
            *("--sim-port-in", str(simulator_in), "--sim-port-out", str(simulator_out)),
            *("--serial0", f"tcp:{own}:wait", "--serial1", f"tcp:{attacker}:nowait"),
            *("--serial2", "none:2"),
        )
        return connected(own, STATION), connected(attacker, STATION)


class Px4(Vehicle):
    """PX4's quadcopter in SIH. The binary is in ``bin`` of its build folder."""

    def __init__(self, folder: Path, binary: Path) -> None:
        super().__init__(folder)
        self._binary = binary
        self._instance = 20 + os.getpid() % 200

    def _open(self) -> tuple[Link, Link]:
        variables = {
            "PX4_SIM_MODEL": "sihsim_quadx",
            "PX4_SIMULATOR": "sihsim",
            "PX4_SIM_SPEED_FACTOR": str(SPEEDUP),
            "PX4_HOME_LAT": str(HOME.latitude_deg),
            "PX4_HOME_LON": str(HOME.longitude_deg),
            "PX4_HOME_ALT": str(HOME.altitude_m),
            "PX4_PARAM_MAV_SYS_ID": "1",
            "PX4_PARAM_SDLOG_MODE": "-1",  # no flight log on disk
            "PX4_PARAM_COM_RC_IN_MODE": "4",  # there is no radio control
        }
        etc = self.folder / "etc"
        shutil.copytree(self._binary.parents[1] / "etc", etc)
        # Its start script would derive the system id from the instance.
        script = etc / "init.d-posix" / "rcS"
        script.write_text(re.sub(r"^param set MAV_SYS_ID .*$", "", script.read_text(), flags=re.MULTILINE))
        self._run(str(self._binary), "-d", "-i", str(self._instance), str(etc), variables=variables)
        log = self.folder / "autopilot.log"
        until = monotonic() + PATIENCE_S
        while b"Startup script returned successfully" not in log.read_bytes():
            if monotonic() > until or self._process.poll() is not None:
                raise StationError(f"PX4 did not start: {log.read_text(errors='replace')[-500:]}")
            sleep(0.1)
        self._shell("mavlink", "stop-all")
        local, local_attacker = free_ports(2)
        own, attacker = free_ports(2)
        links = listening(own, STATION), listening(attacker, STATION)
        self._start_link(local, own, "-m", "onboard")
        self._start_link(local_attacker, attacker)  # in the mode for a ground station
        return links

    def take_off(self, station: Station) -> None:
        """It holds its position at the height of MIS_TAKEOFF_ALT."""
        nan = float("nan")
        _repeat(
            station,
            lambda: (
                not station.command(mavlink.MAV_CMD_NAV_TAKEOFF, nan, 0, 0, nan, nan, nan, nan)
                and not station.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
            ),
        )
        station.until(lambda: station.seen.latest["HEARTBEAT"].custom_mode == _PX4_HOLD, "the mode HOLD")
        station.pass_time(10)

    def _start_link(self, local: int, remote: int, *mode: str) -> None:
        ports = ("-u", str(local), "-o", str(remote), "-t", "127.0.0.1")
        self._shell("mavlink", "start", "-x", "-f", *ports, *mode, "-r", "1000000")

    def _shell(self, command: str, *arguments: str) -> None:
        client = self._binary.parent / f"px4-{command}"
        words: Sequence[str] = (str(client), "--instance", str(self._instance), *arguments)
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
        if done.returncode:
            raise StationError(f"px4-{command} {' '.join(arguments)}: {done.stdout}{done.stderr}")


def _take_off_guided(station: Station) -> None:
    station.until(lambda: "LOCAL_POSITION_NED" in station.seen.number, "a local position")
    accepted = mavlink.MAV_RESULT_ACCEPTED
    _repeat(station, lambda: station.command(mavlink.MAV_CMD_DO_SET_MODE, 1, _GUIDED) == accepted)
    # One after the other without a pause: it disarms itself if it does not take off soon.
    _repeat(
        station,
        lambda: (
            station.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == accepted
            and station.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HEIGHT_M) == accepted
        ),
    )
    position = station.seen.latest
    station.until(lambda: position["GLOBAL_POSITION_INT"].relative_alt > 950 * HEIGHT_M, "the vehicle to be up")
    station.pass_time(10)


def _repeat(station: Station, attempt: Callable[[], bool]) -> None:
    """Try once a second of the autopilot's time until it succeeds."""
    until = monotonic() + PATIENCE_S
    while not attempt():
        if monotonic() > until:
            raise StationError(f"the autopilot refuses; last texts: {station.seen.texts[-5:]}")
        station.pass_time(1)
