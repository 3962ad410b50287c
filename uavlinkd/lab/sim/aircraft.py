"""An aircraft for an evaluation: an autopilot, simulated here or real, with the ground station that flies it."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight
from uavlinkd.lab.sim.ground_pilot import GroundPilot
from uavlinkd.lab.sim.links import MavlinkConnection, OnFrame, open_connection
from uavlinkd.lab.sim.real_autopilot import Firmware, RealAutopilot, RealAutopilotSettings, binary_of
from uavlinkd.lab.sim.vehicle import GeoPoint

OUR_SIMULATOR = "our simulator"
_PX4_INSTANCES = 10_000
"""PX4 adds the instance to port numbers up to 19,450."""


FLYING = (Firmware.ARDUPILOT, Firmware.PX4)
"""The real autopilots that are aircraft."""


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


def unused_variables(choice: AircraftChoice, environ: Mapping[str, str] = os.environ) -> list[str]:
    """The environment variables that name a real autopilot other than the chosen one."""
    return [
        firmware.variable for firmware in FLYING if firmware is not choice.firmware and environ.get(firmware.variable)
    ]


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
        """The autopilot and its version."""
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

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
