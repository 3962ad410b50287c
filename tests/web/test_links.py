"""Real daemons on the page: paths, problems in the words of ``uavlinkd status``, refusals, members of a relay."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys

import pytest
from playwright.async_api import Browser, Locator, expect

from tests.processes.fleet import relay_for
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.relay import End, Relay
from tests.processes.udp import shown
from tests.web.browser import card_of, headline, window
from tests.web.served import served
from uavlinkd.ops.status_words import problems

pytestmark = [pytest.mark.asyncio(loop_scope="module"), pytest.mark.long]


async def along_two_paths(stage: Stage) -> tuple[DaemonProcess, DaemonProcess, list[Relay]]:
    """A linked pair with two networks between them. A network whose ``on_datagram`` does nothing is pulled."""
    drone, ground, psk = stage.daemon("drone0"), stage.daemon("ground"), stage.psk()
    networks = [await stage.relay() for _ in range(2)]
    for network in networks:
        network.attach(End.A, drone.sockaddr)
        network.attach(End.B, ground.sockaddr)
    drone.add_peer(ground, [shown(network.address_for(End.A)) for network in networks], psk)
    ground.add_peer(drone, [shown(network.address_for(End.B)) for network in networks], psk)
    await stage.start(drone, ground)
    return drone, ground, networks


def role_of(path: Locator) -> Locator:
    return path.locator("small")


async def test_a_pulled_path_is_down_and_the_other_best(browser: Browser) -> None:
    """The page follows a path that is pulled, and that comes back."""
    async with Stage() as stage:
        drone, ground, networks = await along_two_paths(stage)
        async with served(ground.folder / "control.sock") as web, window(browser, web.url) as page:
            card = card_of(page, drone.name)
            await expect(card.locator(".state")).to_have_text("up")
            await expect(card.locator(".path.usable")).to_have_count(2)
            await expect(card.get_by_text("best", exact=True)).to_have_count(1)
            status = await ground.status()
            numbers = {path["address"]: path["number"] for path in status["peers"][drone.name]["paths"]}
            keys = [numbers[shown(network.address_for(End.B))] for network in networks]
            paths = [card.locator(f".path[data-key='{key}']") for key in keys]
            pulled, other = paths if await role_of(paths[0]).inner_text() == "best" else reversed(paths)
            network = networks[paths.index(pulled)]
            network.on_datagram = lambda end, datagram: None
            await expect(role_of(pulled)).to_have_text("down: no answer")
            await expect(pulled.get_by_role("cell")).to_have_text(["-", "-", ""])
            await expect(role_of(other)).to_have_text("best")
            await expect(other.get_by_role("rowheader")).to_contain_text("direct")
            await card.get_by_text("Details").click()
            await expect(card).to_contain_text("best, carries all")
            await expect(card).to_contain_text("round trip -, loss - in, - out, ")
            await expect(headline(page)).to_have_text("1 of 1 peers up")
            network.on_datagram = network.deliver
            await expect(card.locator(".path.usable")).to_have_count(2)


async def test_a_problem_has_the_words_of_status(browser: Browser) -> None:
    """A wrong PSK: cause and remedy are those that the terminal shows, and the link is not up."""
    async with Stage() as stage:
        drone, ground = stage.daemon("drone0"), stage.daemon("ground")
        drone.add_peer(ground, [ground.address], stage.psk())
        ground.add_peer(drone, [drone.address], stage.psk())
        await stage.start(drone, ground, linked=False)
        status = await ground.until(
            lambda status: ["the PSKs differ" in finding["text"] for finding in status["findings"]] == [True]
        )
        async with served(ground.folder / "control.sock") as web, window(browser, web.url) as page:
            shown_problem = page.get_by_role("region", name="Problems", exact=True).get_by_role("listitem")
            await expect(shown_problem).to_have_count(1)
            (line,) = problems(status["findings"])
            plain = [f"{line.text}.", f"Remedy: {line.remedy}."]
            said = [f"{line.severity}{line.who}", *(text.replace("`", "") for text in plain)]
            await expect(shown_problem.get_by_role("paragraph")).to_have_text(said)
            await expect(card_of(page, drone.name).locator(".state")).to_have_text("waiting")
            await expect(headline(page)).to_have_text("0 of 1 peers up")
            await expect(page.get_by_role("region", name="Log of problems")).to_contain_text(said[2])
        assert f"{line.who}: {line.text}. Remedy: {line.remedy}" in await terminal(ground)


async def terminal(daemon: DaemonProcess) -> str:
    """What ``uavlinkd status`` prints, without line breaks."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "uavlinkd", "status", "--socket", str(daemon.folder / "control.sock")),
        stdout=subprocess.PIPE,
        env={**os.environ, "COLUMNS": "200"},
    )
    output, _ = await process.communicate()
    return " ".join(output.decode().split())


async def test_a_relay_shows_its_members(browser: Browser) -> None:
    """A table of them, and which are up."""
    async with Stage() as stage:
        drone, ground, psk = stage.daemon("drone0"), stage.daemon("ground"), stage.psk()
        drone.add_peer(ground, [], psk)
        ground.add_peer(drone, [], psk)
        relay = relay_for(stage, drone, ground)
        await stage.start(relay, drone, ground)
        async with served(relay.folder / "control.sock") as web, window(browser, web.url) as page:
            members = page.get_by_role("region", name="Members of this relay")
            states = members.get_by_role("row").locator("td:nth-child(2)")
            await expect(states).to_have_text(["up", "up"])
            await expect(members.get_by_role("row").filter(has_text=drone.name)).to_contain_text(drone.address)
            await expect(headline(page)).to_have_text("relay: 2 of 2 members up")
            await drone.stop()
            await expect(members.get_by_role("row").filter(has_text=drone.name).locator(".state")).to_have_text(
                "lost"
            )
            await expect(headline(page)).to_have_text("relay: 1 of 2 members up")
            await members.get_by_label("Search").fill("GROUND")
            await expect(states).to_have_text(["up"])
