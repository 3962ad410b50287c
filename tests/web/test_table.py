"""Two hundred peers: the table sorts, searches and links, and costs the browser little."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from playwright.async_api import Browser, Page, expect

from tests.web.browser import headline, window
from tests.web.made_up_daemon import MadeUpDaemon, make_up
from tests.web.served import page_of

pytestmark = [pytest.mark.asyncio(loop_scope="module"), pytest.mark.long]

PEERS = 200
RENDERS = 20
MOST_S = 0.3
"""Processor time of the window for one event. A fifth of it was measured, beside other tests."""


@asynccontextmanager
async def fleet(browser: Browser) -> AsyncIterator[tuple[MadeUpDaemon, Page]]:
    """A window with a table of peers that differ in round trip and loss."""
    daemon = await make_up(PEERS)
    for number, peer in enumerate(daemon.status["peers"].values(), 1):
        peer |= {"round_trip_s": 0.001 * (number * 7 % PEERS + 1), "loss_in": number / PEERS, "loss_out": 0.0}
    async with page_of(daemon.answer) as web, window(browser, web.url) as page:
        await expect(page.get_by_role("table").first.get_by_role("row")).to_have_count(PEERS + 1)
        yield daemon, page


async def test_a_table_sorts_and_searches(browser: Browser) -> None:
    """By the keyboard too. The focus stays on a column's title while events change the table."""
    async with fleet(browser) as (daemon, page):
        rows, first = page.locator("#peers tbody tr"), page.locator("#peers tbody tr").first
        title = page.get_by_role("button", name="loss")
        column = page.get_by_role("columnheader", name="loss")
        await title.click()
        await expect(column).to_have_attribute("aria-sort", "ascending")
        await expect(first).to_contain_text("drone1")
        await page.keyboard.press("Enter")
        await expect(column).to_have_attribute("aria-sort", "descending")
        await expect(first).to_contain_text("drone200")
        daemon.status["peers"]["drone77"]["loss_in"] = 2.0
        await expect(first).to_contain_text("drone77")
        await expect(title).to_be_focused()
        daemon.status["peers"]["drone9"]["state"] = "lost"
        await page.get_by_role("button", name="state").click()
        await expect(first).to_contain_text("drone9")
        await page.get_by_role("searchbox").first.fill("DRONE19")
        await expect(rows).to_have_count(11)  # 19, and 190 to 199
        await page.get_by_role("searchbox").first.fill("no such peer")
        await expect(rows).to_have_count(0)


async def test_a_link_to_a_peer_works(browser: Browser) -> None:
    """From the table, as an address of its own, and for a peer that does not exist."""
    async with fleet(browser) as (_, page):
        await page.get_by_role("link", name="drone123", exact=True).click()
        await expect(page.get_by_role("heading", level=1)).to_have_text("drone123")
        await expect(page.get_by_role("article")).to_contain_text("public key")
        await expect(page.locator("#peers")).to_be_hidden()
        assert page.url.endswith("/peer/drone123")
        await page.reload()
        await expect(page.get_by_role("article").locator(".state")).to_have_text("up")
        await page.goto(page.url.replace("drone123", "drone0"))
        await expect(headline(page)).to_contain_text("drone0 has no peer of this name")
        await page.get_by_role("link", name="all peers").click()
        await expect(headline(page)).to_have_text("200 of 200 peers up")


async def test_an_event_costs_the_window_little(browser: Browser) -> None:
    """Each row has other figures in each event, as in flight."""
    async with fleet(browser) as (_, page):
        session = await page.context.new_cdp_session(page)
        await session.send("Performance.enable", {"timeDomain": "threadTicks"})

        async def spent_s() -> float:
            metrics = (await session.send("Performance.getMetrics"))["metrics"]
            return next(float(one["value"]) for one in metrics if one["name"] == "TaskDuration")

        before_s = await spent_s()
        await page.evaluate(
            """async (count) => {
              for (let n = 1; n <= count; n++) {
                now.rows = now.rows.map((row) => row.with(2, n / 10).with(5, 1000 + n));
                render();
                await new Promise(requestAnimationFrame);
              }
            }""",
            RENDERS,
        )
        each_s = (await spent_s() - before_s) / RENDERS
        assert 0 < each_s < MOST_S
