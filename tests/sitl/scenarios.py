"""The list of scenarios, and running one of them: a record of what was flown, how, and with which result."""

from __future__ import annotations

import tempfile
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.downloads import downloads
from tests.sitl.flights import flight, outages, restarts, two_radios, two_vehicles
from tests.sitl.pilots import COPTER, OWN, PX4, Kind, Pilot
from tests.sitl.radio import BY_NAME, CLEAN
from tests.sitl.relayed import relayed
from tests.sitl.roles import roles
from tests.sitl.simulators import Firmware, OwnSimulator, RealSimulator, Simulator
from tests.sitl.station import Station
from tests.sitl.transfers import Figures, FlightError, parameters_and_mission, signing, whole_log
from tests.sitl.world import Layout, World, flying
from uavlinkd.lab.sim.loopback_ports import free_port

KINDS: Mapping[str, Kind] = {"ardupilot": COPTER, "px4": PX4, "own": OWN}
ALL_KINDS = tuple(KINDS)
ALL_CONDITIONS = tuple(BY_NAME)

UNEQUAL = ({"delay_s": 0.005}, {"delay_s": 0.05})
"""Two paths that differ by 45 ms."""

Scene = Callable[[World, list[Pilot]], Awaitable[Figures]]


@dataclass(frozen=True, slots=True)
class Scenario(Layout):
    """What is flown, with which vehicles, and under which conditions."""

    name: str
    scene: Scene
    kinds: tuple[str, ...] = ("ardupilot", "px4")
    conditions: tuple[str, ...] = (CLEAN.name,)
    vehicles: int = 1
    has_maintenance_port: bool = False


def _alone(scene: Callable[[World, Pilot], Awaitable[Figures]]) -> Scene:
    return lambda world, pilots: scene(world, pilots[0])


SCENARIOS = (
    Scenario("parameters-mission", _alone(parameters_and_mission), ALL_KINDS, ALL_CONDITIONS),
    Scenario("flight", _alone(flight), ("ardupilot", "px4"), ALL_CONDITIONS),
    Scenario("log", _alone(whole_log)),
    Scenario("signing", _alone(signing), ("ardupilot",), has_maintenance_port=True),
    Scenario("two-vehicles", two_vehicles, vehicles=2),
    Scenario("outages", _alone(outages), radios=({},)),
    Scenario("restarts", _alone(restarts)),
    Scenario("two-radios", _alone(two_radios), radios=({}, {})),
    Scenario("relay", _alone(relayed), ("ardupilot", "px4"), relays=1),
    Scenario("roles", _alone(roles), ("ardupilot", "px4", "own"), is_direct=True),
    Scenario("two-relays", _alone(relayed), ("ardupilot", "px4"), relays=2),
    Scenario("relay-tls", _alone(relayed), ("ardupilot",), relays=1, by_tls=True),
    Scenario("outages-tls", _alone(outages), ("ardupilot",), relays=1, by_tls=True),
    Scenario("downloads", _alone(downloads), ("ardupilot",), has_maintenance_port=True),
    Scenario("downloads-relay", _alone(downloads), ("ardupilot",), has_maintenance_port=True, relays=1),
    Scenario("downloads-paths", _alone(downloads), ("ardupilot",), has_maintenance_port=True, radios=UNEQUAL),
    Scenario("downloads-tls", _alone(downloads), ("ardupilot",), has_maintenance_port=True, relays=1, by_tls=True),
)
SCENARIO_BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}


@dataclass(frozen=True, slots=True)
class Run:
    """One scenario under one condition."""

    scenario: str
    kind: str
    condition: str = CLEAN.name

    def __str__(self) -> str:
        return f"{self.scenario}-{self.kind}-{self.condition}"


@dataclass(slots=True)
class Record:
    """The result of a run. ``error`` is None if all assertions held."""

    run: Run
    version: str = ""
    seconds: float = 0.0
    error: str | None = None
    figures: dict[str, Any] = field(default_factory=dict)


def runs(kind: str) -> list[Run]:
    """Every scenario of an autopilot under each of its conditions."""
    return [
        Run(scenario.name, kind, condition)
        for scenario in SCENARIOS
        if kind in scenario.kinds
        for condition in scenario.conditions
    ]


async def fly(run: Run) -> Record:
    """Fly a scenario; a failure is in the record."""
    record = Record(run)
    began = monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="sitl-") as folder:
            await _fly(run, record, Path(folder))
    except FlightError as error:
        record.error, record.figures = str(error), error.figures
    except Exception as error:  # the runs after this one are flown all the same
        record.error = f"{type(error).__name__}: {error}"
    record.seconds = round(monotonic() - began, 1)
    return record


async def _fly(run: Run, record: Record, folder: Path) -> None:
    scenario, kind = SCENARIO_BY_NAME[run.scenario], KINDS[run.kind]
    maintenance_port = free_port() if scenario.has_maintenance_port else None
    systems = range(1, scenario.vehicles + 1)
    simulators = [_simulator(run.kind, system, folder / str(system), maintenance_port) for system in systems]
    condition = BY_NAME[run.condition]
    async with flying(simulators, scenario, condition, maintenance_port=maintenance_port) as world:
        pilots = [Pilot(world.station, system, kind) for system in systems]
        record.version = await version(world.station, 1)
        record.figures = await scenario.scene(world, pilots)


def _simulator(name: str, system: int, folder: Path, maintenance_port: int | None) -> Simulator:
    if KINDS[name] is OWN:
        folder.mkdir()
        return OwnSimulator(system, folder)
    parameters = KINDS[name].parameters
    return RealSimulator(Firmware(name), system, folder, parameters=parameters, maintenance_port=maintenance_port)


async def version(station: Station, system: int) -> str:
    """The version that the autopilot reports, with the first digits of its commit."""
    with station.inbox(system, "AUTOPILOT_VERSION") as inbox:
        for _ in range(20):
            await station.command(system, mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            answer = await inbox.next(2.0)
            if answer is not None:
                number = answer.flight_sw_version
                commit = bytes(answer.flight_custom_version).rstrip(b"\0").decode("ascii", "replace")
                kind = "-dev" if number & 255 < mavlink.FIRMWARE_VERSION_TYPE_ALPHA else ""
                name = f"{number >> 24}.{number >> 16 & 255}.{number >> 8 & 255}{kind}"
                return f"{name} {commit}" if commit.isalnum() else name
    return "unknown"
