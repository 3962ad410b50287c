"""Makes the pictures of the page for the README: ``python -m tests.web.screenshots --out configs/web``.

A ground station and two vehicles, real daemons on this machine, with two emulated networks between them. The
simulator flies both vehicles. LTE of the second one fails for a minute. At last the plots are full.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Final

from playwright.async_api import Browser

from tests.processes.fleet import AN_OPERATOR, a_vehicle, beat
from tests.processes.frames import ground_heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.relay import End, Relay
from tests.processes.udp import shown
from tests.web.browser import Scheme, card_of, open_browser, window
from tests.web.served import served
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.web.watch import SAMPLE_S, SAMPLES

Deliver = Callable[[End, bytes], None]

MOST_BYTES: Final = 200_000
NETWORKS: Final = {"lte": ("127.0.0.2", 0.045, 0.002), "mesh": ("127.0.0.3", 0.012, 0.005)}
"""By name: the address on each host, the least delay in seconds, and the share of datagrams that are lost."""
FAILS_AFTER_S, FAILS_FOR_S = 300.0, 60.0


def slow(network: Relay, delay_s: float, loss: float) -> Deliver:
    """Delivers late, in order, and not everything. Delays differ, as on a radio that repeats what was damaged."""
    loop = asyncio.get_running_loop()
    due = dict.fromkeys(End, 0.0)

    def on_datagram(end: End, datagram: bytes) -> None:
        if random.random() >= loss:
            due[end] = max(due[end] + 1e-6, loop.time() + delay_s * random.uniform(1, 1.4))
            loop.call_at(due[end], network.deliver, end, datagram)

    return on_datagram


async def connect(stage: Stage, ground: DaemonProcess, vehicle: DaemonProcess, system: int) -> dict[str, Relay]:
    """Put both networks between two daemons."""
    psk, networks = stage.psk(), {}
    for name, (_, delay_s, loss) in NETWORKS.items():
        network = networks[name] = await stage.relay()
        network.on_datagram = slow(network, delay_s, loss)
    for daemon, peer, end, settings in (
        (vehicle, ground, End.A, AN_OPERATOR),
        (ground, vehicle, End.B, a_vehicle(system)),
    ):
        daemon.add_peer(peer, [], psk, **settings)
        daemon.config["peer"][-1]["addresses"] = [
            {"address": shown(network.address_for(end)), "network": name} for name, network in networks.items()
        ]
    return networks


def with_networks(stage: Stage, name: str) -> DaemonProcess:
    daemon = stage.daemon(name, [f"0.0.0.0:{free_port()}"])
    daemon.config["network"] = [{"name": name, "address": address} for name, (address, *_) in NETWORKS.items()]
    return daemon


@asynccontextmanager
async def flying(url: str, system: int) -> AsyncIterator[None]:
    """A simulated vehicle at an endpoint."""
    command = [sys.executable, "-m", "uavlinkd", "sim", "--url", url, "--system-id", str(system)]
    process = await asyncio.create_subprocess_exec(*end_with_parent(*command), stdout=asyncio.subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        await process.wait()


async def picture(browser: Browser, url: str, file: Path, width: int, height: int, scheme: Scheme) -> None:
    async with window(browser, url, width, scheme) as page:
        await page.set_viewport_size({"width": width, "height": height})
        await card_of(page, "v2").locator(".path.usable polyline").nth(5).wait_for(state="attached")
        made = await page.screenshot(path=file)
    assert len(made) <= MOST_BYTES, f"{file} has {len(made)} bytes"


async def make(folder: Path, seconds: float) -> None:
    """Both pictures, after so many seconds of flight."""
    async with Stage() as stage, AsyncExitStack() as stack:
        ground, pilot = with_networks(stage, "gs"), await stage.client()
        into = ground.add_endpoint("qgc")
        vehicles = [with_networks(stage, f"v{system}") for system in (1, 2)]
        for system, vehicle in enumerate(vehicles, 1):
            networks = await connect(stage, ground, vehicle, system)
            host, port = vehicle.add_endpoint("autopilot")
            await stack.enter_async_context(flying(f"udpout:{host}:{port}", system))
        await stage.start(ground, *vehicles)
        web = await stack.enter_async_context(served(ground.folder / "control.sock"))
        browser = await stack.enter_async_context(open_browser())
        async with asyncio.TaskGroup() as tasks:
            heartbeats = tasks.create_task(beat(lambda number: pilot.send(ground_heartbeat(number), into)))
            await asyncio.sleep(min(FAILS_AFTER_S, seconds / 2))
            works, networks["lte"].on_datagram = networks["lte"].on_datagram, lambda end, datagram: None
            await asyncio.sleep(min(FAILS_FOR_S, seconds / 4))
            networks["lte"].on_datagram = works
            await asyncio.sleep(max(seconds / 4, seconds - FAILS_AFTER_S - FAILS_FOR_S))
            await picture(browser, web.url, folder / "page.png", 1400, 800, "light")
            await picture(browser, web.url, folder / "phone.png", 360, 740, "dark")
            heartbeats.cancel()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="make the pictures of the page for the README")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=SAMPLE_S * SAMPLES, help="of flight (default: %(default)s)")
    options = parser.parse_args()
    asyncio.run(make(options.out, options.seconds))
