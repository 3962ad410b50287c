"""``uavlinkd demo --web`` in a real browser."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from playwright.async_api import expect

from tests.lab.demo.test_demo_web import folder, page
from tests.web.browser import open_browser, window
from uavlinkd.lab.demo.web import ATTACKS

__all__ = ["folder"]  # a fixture


@pytest.mark.long
async def test_each_attack_in_a_browser(folder: Path) -> None:
    """The buttons, what the page then says, and that it notices the end of the demo."""
    async with (
        page(folder=folder) as (process, url),
        open_browser() as browser,
        window(browser, url, is_interrupted=True) as shown,
    ):
        attacks = shown.get_by_role("region", name="Attacks")
        row = attacks.get_by_role("row").nth(1).get_by_role("cell")
        for text in ATTACKS:
            await attacks.get_by_role("button", name=text).click()
            await expect(row.first).to_have_text(text)
            await expect(attacks.get_by_role("status")).to_have_text("Choose an attack.")
            assert int((await row.nth(1).inner_text()).replace(",", "")) > 0
            assert (await row.nth(2).inner_text())[0].isdigit(), text
            await expect(attacks).to_contain_text("No forged, altered or replayed frame was delivered.")
        await expect(shown.get_by_role("article").locator(".state")).to_have_text(re.compile("up|warning"))
        process.send_signal(signal.SIGINT)
        await expect(shown.get_by_text("The demo does not answer")).to_be_visible()
