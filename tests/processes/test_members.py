"""Members by certificate, as processes: links without a file that names the other end, and revocation."""

from __future__ import annotations

import asyncio

import pytest

from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.members import CertifiedFleet, Swarm, is_up, start_swarm
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


@pytest.fixture
async def swarm(stage: Stage) -> Swarm:
    """No vehicle listens."""
    return await start_swarm(stage, [])


async def test_members_get_newer_certificates(swarm: Swarm) -> None:
    """All get new certificates, each along live links. Then the least serial rises: no link ends."""
    fleet, *daemons = swarm
    ground = daemons[0]
    before = [(await daemon.status())["peers"] for daemon in daemons]
    await ground.ask(fleet.renew(*daemons))
    for daemon in daemons:
        await daemon.until(
            lambda status: min(status["fleet"]["serial"], *status["fleet"]["held"].values()) > 3  # all are new
        )
    await ground.ask(fleet.raise_least(4))
    for daemon in daemons:
        await daemon.until(lambda status: {2, *status["fleet"]["bulletins"].values()} == {2})
    after = [(await daemon.status())["peers"] for daemon in daemons]
    for earlier, later in zip(before, after, strict=True):
        assert {name: peer["handshakes"] for name, peer in earlier.items()} == {
            name: peer["handshakes"] for name, peer in later.items()
        }
    assert {peer["state"] for peer in after[1].values()} == {"up"}
    await daemons[1].stop()
    await daemons[1].start()  # its file has a certificate of its contact that is refused now
    await daemons[1].until(lambda status: is_up(status, "ground", "v2"))
