"""Members by certificate, as processes: links without a file that names the other end, and revocation."""

from __future__ import annotations

from tests.daemon.frames import frame
from tests.daemon.harness import Stage
from tests.daemon.members import CertifiedFleet
from uavlinkd.core.certificates import MemberRole


async def test_members_meet_at_a_relay(stage: Stage) -> None:
    """A vehicle and a ground station know the relay only. Frames pass; a revoked vehicle is cut off everywhere."""
    fleet = CertifiedFleet()
    relay, ground, vehicle = stage.daemon("relay"), stage.daemon("ground", []), stage.daemon("v1", [])
    fleet.join(relay, MemberRole.RELAY)
    fleet.join(ground, MemberRole.OPERATOR, 255, relay)
    fleet.join(vehicle, MemberRole.VEHICLE, 1, relay)
    into, screen = vehicle.add_endpoint("autopilot"), await stage.client()
    ground.add_endpoint("screen", f"udpout:{screen}")
    await stage.start(relay, ground, vehicle, linked=False)
    await ground.until(lambda status: status["peers"].get("v1", {}).get("state") == "up")
    autopilot = await stage.client()
    autopilot.send(frame(1), into)
    await screen.until(lambda: screen.received == frame(1))
    answer = await ground.ask(fleet.revoke("v1"))
    assert answer == {"verdict": "newer", "number": 2}
    assert "v1" not in (await ground.status())["peers"]
    await relay.until(lambda status: "v1" not in status["relay"]["members"])
    # The next start of the ground station begins with the bulletin on its disk.
    await ground.stop()
    await relay.stop()
    await ground.start()
    status = await ground.ready()
    assert status["fleet"]["number"] == 2
