"""Ground stations as they come from PyPI fly the simulated autopilot through two daemons, with roles in force.

Between them the scenarios use every kind of endpoint on both sides.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from tests.daemon.fleet import Cable, drone_and_ground, held_back
from tests.daemon.harness import DaemonProcess, Stage, free_port
from tests.lab.sim import scenarios
from tests.lab.sim.scenarios import Seen
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight

SYSTEM = 3


@asynccontextmanager
async def flying(
    stage: Stage, *, drone_url: str, flight_url: str, ground_url: str
) -> AsyncIterator[tuple[Flight, DaemonProcess, DaemonProcess]]:
    """An autopilot, its daemon, and the ground station's: all linked."""
    drone, ground = drone_and_ground(stage, system=SYSTEM)
    # MAVProxy and mavutil speak as 255 here, MAVSDK as 245.
    drone.config["peer"][0]["system_ids"] = [245, 255]
    drone.add_endpoint("autopilot", drone_url)
    ground.add_endpoint("station", ground_url)
    await stage.start(drone, ground)
    async with Flight(flight_url, AutopilotSettings(system_id=SYSTEM)) as flight:
        await drone.until(lambda status: bool(status["endpoints"]["autopilot"]["programs"]))
        yield flight, drone, ground


async def check(
    flight: Flight,
    drone: DaemonProcess,
    ground: DaemonProcess,
    fly: Callable[[], Awaitable[Seen]],
) -> None:
    """Fly; the station saw all there is, the vehicle did it all once, and nothing was lost or refused on the way."""
    before = {parameter.name: parameter.value for parameter in flight.autopilot.parameters.table}
    seen = await fly()
    scenarios.check(seen, system_id=SYSTEM, parameters=before)
    scenarios.check_flown(flight)
    for daemon, peer in ((drone, "ground"), (ground, f"drone{SYSTEM}")):
        status = await daemon.status()
        told = status["peers"][peer]
        assert told["session"]["lost_in"] == 0
        assert held_back(status, "peers", peer) == held_back(status, "peers", peer, "out") == {}
        if daemon is drone:
            assert told["frames_received"] > 15, "it went another way"
            arrived = told["frames_received"]
            await flight.until(lambda arrived=arrived: flight.report().frames_received >= arrived)  # type: ignore[misc]
        else:
            assert told["frames_received"] > 200, "it went another way"


async def test_mavutil_flies_through_a_serial_port(stage: Stage) -> None:
    """mavutil on a serial port, the autopilot a TCP server: connect, parameters, mission, arm, up, down."""
    scenarios.need("pymavlink.mavutil")
    port = free_port()
    with Cable() as cable:
        daemons_end, stations_end = cable.ends
        async with flying(
            stage,
            drone_url=f"tcp:127.0.0.1:{port}",
            flight_url=f"tcpin:127.0.0.1:{port}",
            ground_url=f"serial:{daemons_end}:115200",
        ) as (flight, drone, ground):
            await check(flight, drone, ground, lambda: scenarios.fly_with_mavutil(stations_end))


async def test_mavutil_flies_where_it_listens(stage: Stage) -> None:
    """mavutil listens on UDP, the autopilot calls: connect, parameters, mission, arm, up, down."""
    scenarios.need("pymavlink.mavutil")
    into, station = free_port(), free_port()
    async with flying(
        stage,
        drone_url=f"udpin:127.0.0.1:{into}",
        flight_url=f"udpout:127.0.0.1:{into}",
        ground_url=f"udpout:127.0.0.1:{station}",
    ) as (flight, drone, ground):
        await check(flight, drone, ground, lambda: scenarios.fly_with_mavutil(f"udpin:127.0.0.1:{station}"))


async def test_mavproxy_flies_through_tcp(stage: Stage, tmp_path: Path) -> None:
    """MAVProxy as a TCP client, the autopilot called on UDP: connect, parameters, mission, arm, up, down."""
    scenarios.need("MAVProxy")
    vehicle, station = free_port(), free_port()
    async with flying(
        stage,
        drone_url=f"udpout:127.0.0.1:{vehicle}",
        flight_url=f"udpin:127.0.0.1:{vehicle}",
        ground_url=f"tcpin:127.0.0.1:{station}",
    ) as (flight, drone, ground):
        url = f"tcp:127.0.0.1:{station}"
        await check(flight, drone, ground, lambda: scenarios.fly_with_mavproxy(url, tmp_path, flight))


async def test_mavsdk_flies_through_udp(stage: Stage) -> None:
    """MAVSDK on UDP, the autopilot a TCP client: connect, parameters, mission, arm, up, down."""
    scenarios.need("mavsdk.asyncio")
    vehicle, station = free_port(), free_port()
    async with flying(
        stage,
        drone_url=f"tcpin:127.0.0.1:{vehicle}",
        flight_url=f"tcp:127.0.0.1:{vehicle}",
        ground_url=f"udpin:127.0.0.1:{station}",
    ) as (flight, drone, ground):
        await check(flight, drone, ground, lambda: scenarios.fly_with_mavsdk(f"udpout:127.0.0.1:{station}"))
