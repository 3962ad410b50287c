"""Memory of a daemon that holds certificates of members which are not up: ``python -m tests.bench.held``."""

from __future__ import annotations

import argparse
import asyncio
from functools import partial

from tests import waiting
from tests.authority.signing import signed, vehicle
from tests.bench.measure import resident_bytes
from tests.daemon.harness import Stage
from tests.daemon.members import CertifiedFleet
from tests.relay.core_member import CoreMember
from uavlinkd.core.certificates import MemberRole

OWN_SYSTEM, MOST = 255, 254
SETTLE_S = 20.0


async def memory(held: int, settle_s: float = SETTLE_S) -> tuple[int, int]:
    """Resident bytes before and after a `status` of a vehicle whose relay named so many others, which are silent."""
    async with Stage() as stage:
        fleet, relay, drone = CertifiedFleet(), stage.daemon("relay"), stage.daemon("drone2")
        relay.command = "relay"
        del relay.config["endpoint"], relay.config["peer"]
        fleet.join(relay, MemberRole.RELAY)
        fleet.serial = OWN_SYSTEM
        fleet.join(drone, MemberRole.VEHICLE, OWN_SYSTEM, relay)
        drone.config["fleet"]["call"] = ["vehicle"]
        drone.add_endpoint("autopilot")
        await stage.start(relay, linked=False)
        key = fleet.certificates["relay"][0]
        members = [CoreMember(key, relay.sockaddr, partial(_certify, 1 + number)) for number in range(held)]
        try:
            await waiting.until(lambda: all(member.peer.is_up for member in members))
            await drone.start()
            await drone.until_logged("daemon_started")
            await asyncio.sleep(settle_s)
            before = resident_bytes(drone.pid)
            peers = (await drone.status())["peers"].values()
            assert [peer["state"] == "up" for peer in peers] == [False] * held
            return before, resident_bytes(drone.pid)
        finally:
            for member in members:
                member.close()


def _certify(system: int, key: bytes) -> bytes:
    return signed(vehicle(system, 1 + system), key)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("held", type=int, nargs="*", default=[0, MOST], help="how many certificates, in turn")
    for held in parser.parse_args().held:
        before, after = asyncio.run(memory(held))
        print(f"{held:3} certificates: {before / 1e6:.1f} MB, after a status {after / 1e6:.1f} MB", flush=True)


if __name__ == "__main__":
    main()
