"""Ground stations as they come from PyPI fly the simulated autopilot through two daemons, with roles in force.

Between them the scenarios use every kind of endpoint on both sides.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

from tests import waiting
from tests.lab.sim import scenarios
from tests.lab.sim.scenarios import Seen
from tests.processes.fleet import drone_and_ground, held_back
from tests.processes.frames import heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from uavlinkd.io.url import NetworkUrl, parse_url
from uavlinkd.lab.mitm.modem import ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings
from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight
from uavlinkd.lab.sim.loopback_ports import free_port

SYSTEM = 3


@asynccontextmanager
async def flying(
    stage: Stage, drone_url: str, flight_url: str, ground_url: str
) -> AsyncIterator[tuple[Flight, DaemonProcess, DaemonProcess]]:
    """An autopilot, its daemon, and the ground station's: all linked."""
    drone, ground = drone_and_ground(stage, system=SYSTEM)
    # MAVProxy speaks as 255 here, MAVSDK as 245.
    drone.config["peer"][0]["system_ids"] = [245, 255]
    drone.add_endpoint("autopilot", drone_url)
    ground.add_endpoint("station", ground_url)
    await stage.start(drone, ground)
    url = parse_url(flight_url)
    assert isinstance(url, NetworkUrl)
    async with Flight(url, AutopilotSettings(system_id=SYSTEM)) as flight:
        await drone.until(lambda status: bool(status["endpoints"]["autopilot"]["clients"]))
        yield flight, drone, ground


async def check(
    flight: Flight, drone: DaemonProcess, ground: DaemonProcess, fly: Callable[[], Awaitable[Seen]]
) -> None:
    """Fly; the station saw all there is, the vehicle did it all once, and nothing was lost or refused."""
    before = {parameter.name: parameter.value for parameter in flight.autopilot.parameters.table}
    seen = await fly()
    scenarios.check(seen, system_id=SYSTEM, parameters=before)
    scenarios.check_flown(flight)
    for daemon, peer in ((drone, "ground"), (ground, f"drone{SYSTEM}")):
        status = await daemon.status()
        reported = status["peers"][peer]
        assert reported["session"]["lost_in"] == 0
        held = held_back(status, "peers", peer) + held_back(status, "peers", peer, "out")
        # Rarely, the bytes of an honest frame hide another one.
        assert all(reason == "hidden_frame" and count == 1 for (_, reason), count in held.items()), held
        if daemon is drone:
            assert reported["frames_received"] > 15, "it went another way"
            arrived = reported["frames_received"]
            await waiting.until(lambda arrived=arrived: flight.report.frames_received >= arrived)  # type: ignore[misc]
        else:
            assert reported["frames_received"] > 200, "it went another way"


async def test_mavproxy_flies_through_a_serial_port(stage: Stage) -> None:
    """MAVProxy on a serial port, the autopilot called on UDP: connect, parameters, mission, arm, up, down."""
    fast = ModemSettings(air_bits_s=1e6, line_baud=115_200, turn_around_s=0.0, queue_bytes=1 << 16)
    ports = ModemPorts(PortSettings(stage.folder / "left", stage.folder / "right", fast))
    await ports.start()
    ground_url, url = f"serial:{ports.settings.left}:115200", str(ports.settings.right)
    try:
        await fly_with_mavproxy(stage, ("udpout", "udpin"), ground_url, url)
    finally:
        await ports.stop()


async def test_mavproxy_flies_through_a_socket(stage: Stage) -> None:
    """MAVProxy as a TCP client."""
    address = f"127.0.0.1:{free_port()}"
    await fly_with_mavproxy(stage, ("udpin", "udpout"), f"tcpin:{address}", f"tcp:{address}")


async def fly_with_mavproxy(stage: Stage, air: tuple[str, str], ground_url: str, url: str) -> None:
    """Fly; ``air``: how the vehicle's daemon and the autopilot open their connection."""
    scenarios.need("MAVProxy")
    drone_url, flight_url = (f"{kind}:127.0.0.1:{port}" for port in [free_port()] for kind in air)
    async with flying(stage, drone_url, flight_url, ground_url) as (flight, drone, ground):
        await check(flight, drone, ground, lambda: scenarios.fly_with_mavproxy(url, stage.folder, flight))


async def test_client_that_answers_from_another_port_is_named_and_counts_as_silent(stage: Stage) -> None:
    """Within 10 s, although valid frames arrive all the time. Its frames are not carried."""
    _, b, into, ground = await stage.one_way()
    autopilot, answering = await stage.client(), await stage.client()

    def exchange(status: Status) -> bool:
        autopilot.send(heartbeat(), into)
        if ground.sources:
            answering.send(heartbeat(255), ground.sources[-1])
        causes = {finding["cause"] for finding in status["findings"] if finding["name"] == "ground"}
        return causes >= {"other_port", "client_silent"}

    status = await b.until(exchange, timeout_s=10.0)
    assert any(f"datagrams from {answering} are dropped" in finding["text"] for finding in status["findings"])
    assert status["endpoints"]["ground"]["frames_received"] == 0
    assert autopilot.datagrams == []


async def test_mavsdk_flies_through_udp(stage: Stage) -> None:
    """MAVSDK calls on UDP: connect, parameters, mission, arm, up, down."""
    scenarios.need("mavsdk.asyncio")
    air, ground_at = f"127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
    async with flying(stage, f"udpin:{air}", f"udpout:{air}", f"udpin:{ground_at}") as (flight, drone, ground):
        await check(flight, drone, ground, lambda: scenarios.fly_with_mavsdk(f"udpout:{ground_at}"))
