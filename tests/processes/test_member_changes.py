"""Members by certificate come and go, as processes: by the file of a daemon, and by bulletins."""

from __future__ import annotations

import pytest

from tests.processes.harness import Stage
from tests.processes.members import Swarm, is_up, start_swarm
from tests.processes.process import DaemonProcess, Status
from uavlinkd.system.base64_text import to_base64


@pytest.fixture
async def fleet(stage: Stage) -> Swarm:
    """A ground station that relays; two vehicles that call it and each other."""
    return await start_swarm(stage)


async def reload(daemon: DaemonProcess) -> Status:
    """Its status right after it read its file again."""
    daemon.write_config()
    assert (await daemon.ask("reload"))["problems"] == []
    return await daemon.status()


async def test_names_and_keys_in_the_file_win(fleet: Swarm) -> None:
    """A name that is denied, and a member's key in a [[peer]], at a station that relays; and back."""
    _, ground, one, two = fleet
    ground.config["fleet"]["deny"] = ["v1"]
    status = await reload(ground)
    assert set(status["peers"]) == set(status["relay"]["members"]) == {"v2"}
    await one.until(lambda status: not is_up(status, "ground"))
    del ground.config["fleet"]["deny"]
    ground.add_peer(two, [], role="vehicle", system_ids=[2])
    ground.config["relay_server"]["member_bits_s"] = 70_000_000
    assert "v2" not in (await reload(ground))["fleet"]["held"]
    await ground.until(lambda status: is_up(status, "v1", "v2") and set(status["relay"]["members"]) == {"v1"})
    ground.config["peer"] = []
    assert "v2" not in (await reload(ground))["peers"]
    await ground.until(lambda status: is_up(status, "v1", "v2") and len(status["relay"]["members"]) == 2)


async def test_contact_is_revoked_and_signed_again(fleet: Swarm) -> None:
    """Its link and its relay end at once. A newer certificate in the files brings both back, by a restart."""
    signed, ground, one, _ = fleet
    await one.ask(signed.revoke("ground"))
    status = await one.until(lambda status: "ground" not in status["peers"] and not status["relays"])
    assert status["fleet"]["number"] == 2
    signed.renew(ground)
    one.config["contact"][0]["certificate"] = to_base64(signed.certificates["ground"][1])
    one.write_config()
    answer = await one.ask("reload")
    assert ["contact: has changed" in problem for problem in answer["problems"]] == [True]
    ground.config["fleet"]["certificate"] = one.config["contact"][0]["certificate"]
    ground.config["fleet"]["bulletin"] = to_base64(signed.bulletin)
    for daemon in (ground, one):
        await daemon.stop()
        await daemon.start()
    await one.until(lambda status: is_up(status, "ground") and status["relays"]["ground"]["state"] == "up")
