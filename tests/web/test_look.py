"""The page on a phone, a tablet and a desk, light and dark: it fits, and axe finds no barrier."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from playwright.async_api import Browser, Page, expect

from tests.web.browser import LOOKS, card_of, headline, look_at, overflow, violations, window
from tests.web.made_up_daemon import MadeUpDaemon, make_up
from tests.web.served import page_of

pytestmark = [pytest.mark.asyncio(loop_scope="module"), pytest.mark.long]

LONG_ADDRESS = "[2001:db8:1234:5678:9abc:def0:1234:5678%wlp0s20f3]:65535"


def make_eventful(daemon: MadeUpDaemon) -> None:
    """Peers in every state, and everything that the page can show of them and of the daemon."""
    names = list(daemon.status["peers"])
    for name, severity in zip(names, ("security", "fault", "warning"), strict=False):
        daemon.find(
            name, f"the response from {LONG_ADDRESS} does not authenticate", "compare `uavlinkd pubkey`", severity
        )
    daemon.problems += [one | {"ended_s": 5.0, "began_s": 4000.0} for one in daemon.problems]
    for number, peer in enumerate(daemon.status["peers"].values()):
        peer["state"] = ("up", "up", "up", "lost", "waiting")[number % 5]
        (path,) = peer["paths"]
        unanswered = {"number": 2, "state": "down", "reason": "unanswered", "role": "none", "carries": []}
        peer["paths"] = [path | {"network": "lte"}, path | unanswered | {"network": "mesh", "address": LONG_ADDRESS}]
        peer["path"] = LONG_ADDRESS
        peer["refused"] = {"in": {"GLOBAL_POSITION_INT_COV": {"ground_station_not_allowed": 12345678}}, "out": {}}
        claim = {"message": "COMMAND_LONG", "command": "MAV_CMD_DO_SET_MODE", "reason": "foreign_system"}
        peer["refused_there"] = [claim | {"count": 12, "last_s": 1.0}]
        vehicle = {"system": number, "heartbeat_s": 20.0 * (number % 2), "type": 2, "autopilot": 3, "is_armed": True}
        battery = {"battery_v": 16.1, "battery_percent": 80 if number % 3 else None}
        peer["vehicles"] = [vehicle | battery | {"custom_mode": 17 + number}] * (number % 3)
        peer["commands"] = {"in": number % 3 == 0, "out": True}
    member = {"is_up": True, "since_s": 5.0, "addresses": [LONG_ADDRESS], "bound": 3, "waiting": 1}
    member |= {"datagrams": 12345678, "over_limit": 0}
    daemon.status["relay"] = {"members": dict.fromkeys(names[:20], member), "dropped": {"unknown_peer": 9}}
    daemon.status["drops"] = {"unknown_peer": 12345}
    network = {"interface": "wlp0s20f3", "address": None, "is_metered": True, "is_present": False, "serial": None}
    daemon.status["networks"] = {"lte": network | {"absent_because": "no interface wlp0s20f3", "addresses": []}}


@asynccontextmanager
async def eventful(browser: Browser, count: int, path: str = "") -> AsyncIterator[tuple[MadeUpDaemon, Page]]:
    """A window that shows such a daemon with so many peers, with all its details open."""
    daemon = await make_up(count)
    make_eventful(daemon)
    async with page_of(daemon.answer) as web, window(browser, f"{web.url}{path}") as page:
        await expect(headline(page)).not_to_have_text("Asking the daemon …")
        await page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        try:
            yield daemon, page
        finally:
            daemon.answers.set()


async def check(page: Page) -> None:
    for look in LOOKS:
        await look_at(page, *look)
        assert (look, await overflow(page), await violations(page)) == (look, 0, [])


async def test_cards_and_problems_fit(browser: Browser) -> None:
    """Four peers, each with two paths and a problem."""
    async with eventful(browser, 4) as (_, page):
        await expect(page.get_by_role("article")).to_have_count(4)
        await expect(page.locator("article .state")).to_have_text(["attack", "lost", "blocked", "warning"])
        await expect(page.get_by_role("region", name="Log of problems").get_by_role("row")).to_have_count(7)
        await check(page)


async def test_one_peer_fits(browser: Browser) -> None:
    """The page that a link leads to."""
    async with eventful(browser, 6, "peer/drone5") as (_, page):
        await expect(page.get_by_role("heading", level=1)).to_have_text("drone5")
        await expect(page.locator("article .state")).to_have_text(["waiting"])
        await check(page)


async def test_lost_fits(browser: Browser) -> None:
    """What was true stays, grey and without a state."""
    async with eventful(browser, 4) as (daemon, page):
        daemon.answers.clear()
        await expect(headline(page)).to_contain_text("LOST")
        states = "#state .state, article .state, td .state"
        await expect(page.locator(states)).to_have_text(["unknown"] * 9)
        await expect(page.locator("article.up, .path.usable, .good")).to_have_count(0)
        await check(page)


async def test_two_hundred_peers_fit(browser: Browser) -> None:
    """Tables of peers and of members."""
    async with eventful(browser, 200) as (_, page):
        await expect(page.get_by_role("region", name="All peers").get_by_role("row")).to_have_count(201)
        await expect(page.get_by_role("region", name="Members of this relay").get_by_role("row")).to_have_count(21)
        await check(page)


async def test_what_a_person_opened_stays_open(browser: Browser) -> None:
    """Through new events, and when another part appears above it."""
    daemon = await make_up(1)
    async with page_of(daemon.answer) as web, window(browser, web.url) as page:
        card = card_of(page, "drone1")
        await card.get_by_text("Details", exact=True).click()
        await expect(card.get_by_text("public key")).to_be_visible()
        peer = daemon.status["peers"]["drone1"]
        for count in (1, 2):
            peer["refused"] = {"in": {"HEARTBEAT": {"foreign_system": count}}, "out": {}}
            await expect(card.get_by_role("row").filter(has_text="HEARTBEAT")).to_contain_text(f"{count}")
            await expect(card.get_by_text("public key")).to_be_visible()
