"""A real Chromium, and windows of it in which nothing may go wrong."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Final, Literal, get_args

from axe_playwright_python.async_playwright import Axe
from playwright.async_api import Browser, ConsoleMessage, Locator, Page, Request, async_playwright, expect

from tests.needs import need
from tests.waiting import PATIENCE_S

Scheme = Literal["light", "dark"]

LOOKS: Final[Sequence[tuple[int, Scheme]]] = [
    (width, scheme) for width in (360, 768, 1400) for scheme in get_args(Scheme)
]
"""A phone, a tablet and a desk."""
_CHROMIUM: Final = shutil.which("chromium")
_ABORTED: Final = "net::ERR_ABORTED"
"""The browser itself ended a request: the window went to another page."""


@asynccontextmanager
async def open_browser() -> AsyncIterator[Browser]:
    """Chromium without a screen. Skips the test without it."""
    need(_CHROMIUM is not None, "Chromium (Debian: chromium)")
    expect.set_options(timeout=1000 * PATIENCE_S)
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=_CHROMIUM, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            await browser.close()


@asynccontextmanager
async def window(
    browser: Browser, url: str, width: int = 1400, scheme: Scheme = "light", *, is_interrupted: bool = False
) -> AsyncIterator[Page]:
    """A window at this address. At its end, there must have been no console message, error or failed request.

    ``is_interrupted``: the page's server ends meanwhile, so that requests fail.
    """
    page = await browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page.set_default_timeout(1000 * PATIENCE_S)
    complaints: list[str] = []

    def on_console(message: ConsoleMessage) -> None:
        complaints.append(f"console: {message.type}: {message.text}")

    def on_failure(request: Request) -> None:
        if request.failure != _ABORTED:
            complaints.append(f"request: {request.url}: {request.failure}")

    page.on("console", on_console)
    page.on("pageerror", lambda error: complaints.append(f"error: {error}"))
    page.on("requestfailed", on_failure)
    try:
        await page.goto(url)
        yield page
        assert is_interrupted or complaints == []
    finally:
        await page.close()


async def look_at(page: Page, width: int, scheme: Scheme) -> None:
    """Give the window another width and the colours of another time of day."""
    await page.set_viewport_size({"width": width, "height": 800})
    await page.emulate_media(color_scheme=scheme)


async def overflow(page: Page) -> int:
    """By how many pixels the document is wider than the window."""
    wider: int = await page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
    return max(0, wider)


async def violations(page: Page) -> list[str]:
    """What axe finds: the rule, and the first elements that violate it."""
    found = (await Axe().run(page)).response["violations"]
    return [f"{one['id']}: {[node['html'] for node in one['nodes'][:3]]}" for one in found]


def card_of(page: Page, peer: str) -> Locator:
    """All about one peer."""
    return page.get_by_role("article").filter(has=page.get_by_role("link", name=peer, exact=True))


def headline(page: Page) -> Locator:
    """How many are up, or why the page knows nothing."""
    return page.get_by_role("status")
