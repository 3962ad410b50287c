"""Members by certificate, as processes: links without a file that names the other end, and revocation."""

from __future__ import annotations

import asyncio

import pytest

from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.members import CertifiedFleet, is_up
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.system.base64_text import to_base64


@pytest.mark.short
async def test_members_meet_at_a_relay(stage: Stage) -> None:
    """A vehicle and a ground station know the relay only. Frames pass; a revoked vehicle is cut off everywhere."""
    fleet = CertifiedFleet()
    relay, ground, vehicle = stage.daemon("relay"), stage.daemon("ground", []), stage.daemon("v1", [])
    fleet.join(relay, MemberRole.RELAY)
    fleet.join(ground, MemberRole.OPERATOR, 255, relay)
    fleet.join(vehicle, MemberRole.VEHICLE, 1, relay)
    fleet.join(late := stage.daemon("v2"), MemberRole.VEHICLE, 2)
    into, screen = vehicle.add_endpoint("autopilot"), await stage.client()
    ground.add_endpoint("screen", f"udpout:{screen}")
    await stage.start(relay, ground, vehicle, linked=False)
    await ground.until(lambda status: is_up(status, "v1"))
    await ground.ask(fleet.renew(late))
    status = await ground.status()
    assert (set(status["fleet"]["absent"]), status["frames_pass"]) == ({"v2"}, True), "no one waits for it"
    autopilot = await stage.client()
    autopilot.send(frame(1), into)
    await screen.until(lambda: screen.received == frame(1))
    vehicle.config["fleet"]["deny"] = ["v9"]
    vehicle.write_config()
    assert (await vehicle.ask("reload"))["problems"] == []
    assert (await vehicle.status())["relays"]["relay"]["state"] == "up", "a reload does not end the relay"
    assert await ground.ask(fleet.revoke("v1")) == {"verdict": "newer", "number": 2}
    assert "v1" not in (await ground.status())["peers"]
    await relay.until(lambda status: "v1" not in status["relay"]["members"])
    await relay.until(lambda status: status["drops"].get("certificate_revoked", 0) > 0)
    assert (await vehicle.until(lambda status: status["fleet"]["is_revoked"]))["fleet"]["number"] == 2
    assert to_base64(fleet.certificates["ground"][1]) in (stage.folder / "v1" / "v1.fleet-state").read_text()
    await asyncio.gather(ground.kill(), relay.stop())
    await ground.start()
    known = (await ground.ready())["fleet"]
    assert (known["number"], set(known["absent"])) == (2, {"v2"}), "both are on its disk"
