"""``python -m tests.modem.members [TRIES]``: a member by certificate on the only radio of a ground station.

Two real daemons with emulated modems of 4,000 bit/s between them, and heartbeats in both directions. A new member
comes, then bulletins are published at the station.
"""

from __future__ import annotations

import asyncio
import sys
import time
from base64 import b64encode
from contextlib import redirect_stdout, suppress
from datetime import datetime
from io import StringIO
from itertools import pairwise
from statistics import median
from typing import Final, NamedTuple

from tests.processes.frames import ground_heartbeat, heartbeat, sender_of
from tests.processes.harness import Stage
from tests.processes.members import CertifiedFleet
from tests.processes.process import DaemonProcess
from tests.processes.udp import Client, Sockaddr
from tests.waiting import until
from uavlinkd.authority.certificates import MOST_REVOKED, MemberRole
from uavlinkd.lab.mitm.modem import ModemEnd, ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings

MODEM: Final = ModemSettings(air_bits_s=4000.0)
LINK: Final = {"tag_bits": 96, "coalesce_s": 0.2, "max_age_s": 2.0}
HEARTBEAT_S: Final = 1.0
SETTLE_S: Final = 10.0
"""With heartbeats, before a publication and after it."""
FEW: Final = 3
VEHICLE, GROUND = 1, 255


class Outcome(NamedTuple):
    """Seconds."""

    linked_s: float
    """From when the vehicle listened until both ends have the link."""
    few_s: float
    """From the publication of a bulletin that revokes :data:`FEW` until the vehicle has it on its disk."""
    most_s: float
    """The same for the longest one."""
    longest_gap_s: float
    """Between heartbeats that arrived, in either direction."""


async def play(stage: Stage, *, settle_s: float = SETTLE_S) -> Outcome:
    """One station, one vehicle, two bulletins."""
    fleet = CertifiedFleet()
    ground, vehicle = stage.daemon("ground", []), stage.daemon("v1", [])
    fleet.join(ground, MemberRole.OPERATOR, GROUND)
    fleet.join(vehicle, MemberRole.VEHICLE, VEHICLE)
    for daemon, other in ((ground, vehicle), (vehicle, ground)):
        fleet.add_contact(daemon, other, [{"network": "lora"}])
    ports = ModemPorts(PortSettings(stage.folder / "left", stage.folder / "right", MODEM, seed=1))
    for daemon, end in ((vehicle, ModemEnd.LEFT), (ground, ModemEnd.RIGHT)):
        serial = f"{ports.settings.device(end)}:{int(MODEM.line_baud)}"
        daemon.config["network"] = [{"name": "lora", "serial": serial, "air_bits_s": int(MODEM.air_bits_s)}]
        daemon.config["link"].update(LINK)
    ways = vehicle.add_endpoint("autopilot"), ground.add_endpoint("screen")
    clients = await stage.client(), await stage.client()
    await ports.start()
    talking: asyncio.Task[None] | None = None
    try:
        talking = asyncio.create_task(_talk(clients, ways))
        await stage.start(ground, linked=False)
        await vehicle.start()
        await until(lambda: bool(vehicle.events("peer_up") and ground.events("peer_up")))
        (ready,) = vehicle.events("daemon_started")
        linked_s = max(_at(one.events("peer_up")[0]) for one in (vehicle, ground)) - _at(ready)
        await until(lambda: all(_arrivals(*pair) for pair in zip(clients, (GROUND, VEHICLE), strict=True)))
        began = time.monotonic()
        await asyncio.sleep(settle_s)
        few_s = await _publish(fleet, FEW, ground, vehicle)
        await asyncio.sleep(settle_s)
        most_s = await _publish(fleet, MOST_REVOKED, ground, vehicle)
        await asyncio.sleep(settle_s)
        arrived = [_arrivals(*pair) for pair in zip(clients, (GROUND, VEHICLE), strict=True)]
        assert all(times[-1] > began + 3 * settle_s - HEARTBEAT_S * 4 for times in arrived), "heartbeats have ended"
        return Outcome(linked_s, few_s, most_s, max(after - at for times in arrived for at, after in pairwise(times)))
    finally:
        if talking is not None:
            talking.cancel()
        await ports.stop()


async def _publish(fleet: CertifiedFleet, revoked: int, ground: DaemonProcess, vehicle: DaemonProcess) -> float:
    """Publish a bulletin that revokes so many; seconds until the vehicle has it on its disk."""
    state = vehicle.config_file.with_name(f"{vehicle.name}.fleet-state")
    fleet.revoked = list(range(1001, 1001 + revoked))
    request, published = fleet.revoke(), time.time()
    text = b64encode(fleet.bulletin)
    assert (await ground.ask(request))["verdict"] == "newer"

    def has_it() -> bool:
        with suppress(FileNotFoundError):
            return text in state.read_bytes()
        return False

    await until(has_it)
    return state.stat().st_mtime - published


async def _talk(clients: tuple[Client, Client], ways: tuple[Sockaddr, Sockaddr]) -> None:
    """Heartbeats at both ends, without end."""
    number = 0
    while True:
        clients[0].send(heartbeat(VEHICLE, seq=number & 255), ways[0])
        clients[1].send(ground_heartbeat(number & 255), ways[1])
        number += 1
        await asyncio.sleep(HEARTBEAT_S)


def _arrivals(client: Client, system: int) -> list[float]:
    return [at for at, raw in client.arrivals if sender_of(raw) == system]


def _at(event: dict[str, str]) -> float:
    return datetime.fromisoformat(event["timestamp"]).timestamp()


async def main(tries: int) -> None:
    """Print the median and the longest of so many tries."""
    outcomes = []
    for _ in range(tries):
        with redirect_stdout(StringIO()):
            async with Stage() as stage:
                outcomes.append(await play(stage))
        print(outcomes[-1], file=sys.stderr, flush=True)
    for name in Outcome._fields:
        values = [getattr(outcome, name) for outcome in outcomes]
        print(f"{name}: median {median(values):.2f}, longest {max(values):.2f} of {tries}")


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]) if len(sys.argv) > 1 else 20))
