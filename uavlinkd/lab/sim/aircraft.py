"""An aircraft for an evaluation: an autopilot, simulated here or real, with the ground station that flies it.

The commands are those that our simulator, ArduCopter and PX4 have in common. Only the altitude of a take-off differs:
PX4 takes it above mean sea level, the others above home.
"""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight
from uavlinkd.lab.sim.links import MavlinkConnection, OnFrame, open_connection
from uavlinkd.lab.sim.real_autopilot import Firmware, RealAutopilot, RealAutopilotSettings, binary_of
from uavlinkd.lab.sim.vehicle import Axes, GeoPoint, Mode, Vehicle

Message = Any  # a pymavlink message: pymavlink has no types

STATION: Final = (255, 190)
"""System and component ID, as of most ground stations."""
READY_S: Final = 240.0
"""How long an autopilot may take until it can fly: real ones first estimate their position."""
ANSWER_S: Final = 1.0
NEAR_M: Final = 8.0
"""At this distance from a point of a path, the copter is sent to the next one, so that it does not stop."""
_LOOK_S: Final = 0.05
_HEARTBEAT_S: Final = 0.5


class PilotError(Exception):
    """The copter did not do what it was asked to do. The message is for the operator."""


class GroundPilot:
    """Flies one copter. Give it each frame of the copter by :meth:`receive`, and run :meth:`accompany` meanwhile.

    Args:
        system_id: of the copter.
        send: sends a frame to it.
        check: called repeatedly while the pilot waits. It raises if the copter's process has ended.
    """

    def __init__(self, system_id: int, send: Callable[[bytes], object], check: Callable[[], object]) -> None:
        self.system_id = system_id
        self.place: GeoPoint | None = None
        self.home: GeoPoint | None = None
        """The position before take-off."""
        self.version = ""
        """The autopilot and its version, when received."""
        self._send_frame = send
        self._check = check
        self._codec = mavlink.MAVLink(None, *STATION)
        self._codec.robust_parsing = True
        self._is_px4 = False
        self._is_armed = False
        self._height_m = 0.0
        self._acknowledged: dict[int, int] = {}
        self._texts: list[str] = []

    def receive(self, frame: bytes) -> None:
        try:
            message = self._codec.decode(bytearray(frame))
        except mavlink.MAVError:
            return
        match message.get_type():
            case "HEARTBEAT" if message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                self._is_px4 = message.autopilot == mavlink.MAV_AUTOPILOT_PX4
                self._is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            case "GLOBAL_POSITION_INT" if message.lat or message.lon:
                self.place = GeoPoint(message.lat / 1e7, message.lon / 1e7, message.alt / 1e3)
                self._height_m = message.relative_alt / 1e3
            case "COMMAND_ACK":
                self._acknowledged[message.command] = message.result
            case "AUTOPILOT_VERSION":
                self.version = _version(message, is_px4=self._is_px4)
            case "STATUSTEXT":
                self._texts = [*self._texts[-4:], message.text]

    async def accompany(self) -> None:
        while True:
            self._send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
                )
            )
            await asyncio.sleep(_HEARTBEAT_S)

    async def take_off(self, altitude_m: float, position_rate_hz: float) -> None:
        """Take off to an altitude above home, and request the position at a rate.

        Raises:
            PilotError: the copter refused, or did not climb.
        """
        message = mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
        await self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message, 1e6 / position_rate_hz)
        await self._until(lambda: self.place is not None, "it did not report its position")
        await self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        until = asyncio.get_running_loop().time() + READY_S
        while not self._is_armed:
            if not self._is_px4:  # PX4 changes the mode by itself
                flag = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
                await self._command(mavlink.MAV_CMD_DO_SET_MODE, flag, float(Mode.GUIDED))
            # Refused until the position estimate is good enough.
            await self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
            try:
                await self._until(lambda: self._is_armed, "it did not arm", ANSWER_S)
            except PilotError:
                if asyncio.get_running_loop().time() > until:
                    raise
        self.home = self.place
        assert self.home is not None
        target = altitude_m + (self.home.altitude_m if self._is_px4 else 0.0)
        where = (math.nan, math.nan) if self._is_px4 else (0.0, 0.0)
        await self._command(mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, math.nan, *where, target)
        await self._until(lambda: self._height_m > 0.9 * altitude_m, f"it did not climb to {altitude_m:g} m")

    async def follow(self, path: Sequence[Axes]) -> None:
        """Fly along points relative to home, round after round, until cancelled.

        Raises:
            PilotError: the copter does not arrive at a point.
        """
        assert self.home is not None, "the copter has taken off"
        while True:
            for point in path:
                target = Vehicle(self.home).place_of(point)
                reposition = mavlink.MAVLink_command_int_message(
                    *(self.system_id, 1, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_REPOSITION, 0, 0),
                    *(-1.0, mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE, 0.0, math.nan),
                    *(round(target.latitude_deg * 1e7), round(target.longitude_deg * 1e7), target.altitude_m),
                )
                await self._insist(reposition)
                await self._until(lambda t=target: self._is_near(t), "it did not arrive at a point")  # type: ignore[misc]

    def _is_near(self, target: GeoPoint) -> bool:
        assert self.place is not None
        offset = Vehicle(target).point_of(self.place)
        return math.hypot(offset.north, offset.east) < NEAR_M

    async def _command(self, number: int, *parameters: float) -> None:
        seven = (*parameters, *(0.0,) * (7 - len(parameters)))
        await self._insist(mavlink.MAVLink_command_long_message(self.system_id, 1, number, 0, *seven))

    async def _insist(self, message: Message) -> None:
        """Send a command again and again until it is accepted. Raises PilotError if it was not accepted in time."""
        command: int = message.command
        until = asyncio.get_running_loop().time() + READY_S
        while True:
            self._acknowledged.pop(command, None)
            self._send(message)
            with suppress(PilotError):
                await self._until(lambda: command in self._acknowledged, "no answer", ANSWER_S)
            result = self._acknowledged.get(command)
            if result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
                return
            if asyncio.get_running_loop().time() > until:
                reason = "not answered" if result is None else f"refused with the result {result}"
                raise self._failure(f"the command {command} was {reason}")
            if result is not None:
                await asyncio.sleep(ANSWER_S)

    async def _until(self, condition: Callable[[], bool], failure: str, limit_s: float = READY_S) -> None:
        until = asyncio.get_running_loop().time() + limit_s
        while not condition():
            self._check()
            if asyncio.get_running_loop().time() > until:
                raise self._failure(failure)
            await asyncio.sleep(_LOOK_S)

    def _failure(self, text: str) -> PilotError:
        said = f"; it said: {' / '.join(self._texts)}" if self._texts else ""
        return PilotError(f"the copter with system ID {self.system_id}: {text}{said}")

    def _send(self, message: Message) -> None:
        frame = bytes(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256
        self._send_frame(frame)


def _version(message: Message, *, is_px4: bool) -> str:
    number, commit = message.flight_sw_version, bytes(message.flight_custom_version)
    # ArduPilot writes the commit as text, PX4 as a number of 64 bits.
    text = f"{int.from_bytes(commit, 'little'):016x}" if is_px4 else commit.rstrip(b"\0").decode("ascii", "replace")
    name = "PX4" if is_px4 else "ArduCopter"
    return f"{name} {number >> 24}.{number >> 16 & 255}.{number >> 8 & 255} ({text[:8]})"


OUR_SIMULATOR = "our simulator"
_PX4_INSTANCES = 10_000
"""PX4 adds the instance to port numbers up to 19,450."""


FLYING = (Firmware.ARDUPILOT, Firmware.PX4)


@dataclass(frozen=True, slots=True)
class AircraftChoice:
    """The autopilot of an aircraft: ours, or the binary of a real one."""

    firmware: Firmware | None = None
    binary: Path | None = None


def choice_of(environ: Mapping[str, str] = os.environ) -> AircraftChoice:
    """The real autopilot that the environment names, ArduPilot first; otherwise ours.

    Raises:
        RealAutopilotError: the environment names a file that cannot be executed.
    """
    for firmware in FLYING:
        binary = binary_of(firmware, environ)
        if binary is not None:
            return AircraftChoice(firmware, binary)
    return AircraftChoice()


class Aircraft:
    """One aircraft, as an asynchronous context. ``on_frame`` is called with each frame that it sends.

    Args:
        system_id: its MAVLink system ID.
        home: where it takes off.
        folder: for the files of a real autopilot.
    """

    def __init__(
        self, choice: AircraftChoice, system_id: int, home: GeoPoint, folder: Path, on_frame: OnFrame
    ) -> None:
        self._choice = choice
        self._system_id = system_id
        self._home = home
        self._folder = folder
        self._on_frame = on_frame
        self._stack = AsyncExitStack()
        self._link: MavlinkConnection | None = None
        self._real: RealAutopilot | None = None
        self.pilot = GroundPilot(system_id, self._send, self._check)

    @property
    def name(self) -> str:
        return OUR_SIMULATOR if self._choice.firmware is None else self.pilot.version or self._choice.firmware.value

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            self._link = await open_connection("udpin:127.0.0.1:0", self._receive)
            stack.push_async_callback(self._link.close)
            await stack.enter_async_context(self._autopilot(self._link.url.port))
            accompanying = asyncio.create_task(self.pilot.accompany())
            stack.callback(accompanying.cancel)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    def _autopilot(self, port: int) -> AbstractAsyncContextManager[object]:
        if self._choice.firmware is None:
            settings = AutopilotSettings(system_id=self._system_id, home=self._home, seed=self._system_id)
            return Flight(f"udpout:127.0.0.1:{port}", settings)
        assert self._choice.binary is not None
        self._real = RealAutopilot(
            RealAutopilotSettings(
                firmware=self._choice.firmware,
                binary=self._choice.binary,
                udp_port=port,
                home=self._home,
                system_id=self._system_id,
                instance=port % _PX4_INSTANCES,  # another run on this machine has another port
            ),
            self._folder,
        )
        return self._real

    def _check(self) -> None:
        if self._real is not None:
            self._real.check()

    def _send(self, frame: bytes) -> bool:
        return self._link is not None and self._link.send(frame)

    def _receive(self, frame: bytes) -> None:
        self.pilot.receive(frame)
        self._on_frame(frame)
