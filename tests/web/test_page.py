"""The page in a browser: a daemon that ends, and text that an attacker chose."""

from __future__ import annotations

from typing import Final

import pytest
from playwright.async_api import Browser, expect

from tests.web.browser import card_of, window
from tests.web.made_up_daemon import make_up
from tests.web.served import page_of

pytestmark = pytest.mark.asyncio(loop_scope="module")

HOSTILE: Final = (
    "<img src=x onerror=window.ran=1>",
    "</script><script>window.ran=1</script>",
    "\u202egnp.enord\u202c \u2067drone\u2069",
    "javascript:window.ran=1//",
    "${window.ran=1}' onclick='window.ran=1' \" &amp;",
    "../../events?peer=%00#",
)


@pytest.mark.long
async def test_text_that_an_attacker_chose_is_text(browser: Browser) -> None:
    """Names, addresses, problems and reports are shown as they are, run nothing and load nothing."""
    daemon = await make_up(1)
    (real,) = daemon.status["peers"].values()
    (path,) = real["paths"]
    claim = {"command": None, "count": 3, "last_s": 1.0}
    daemon.status["peers"] = {
        text: real
        | {
            "role": text,
            "paths": [path | {"network": text, "address": text}],
            "refused": {"in": {text: {"foreign_system": 7}}, "out": {}},
            "refused_there": [claim | {"message": text, "reason": text}],
        }
        for text in HOSTILE[:4]
    }
    (endpoint,) = daemon.status["endpoints"].values()
    daemon.status["endpoints"] = {text: endpoint | {"clients": {text: {"last_received_s": 1.0}}} for text in HOSTILE}
    daemon.status["name"] = HOSTILE[0]
    for text in HOSTILE:
        daemon.find(text, text, text)
    async with page_of(daemon.answer) as web, window(browser, web.url) as page:
        for text in HOSTILE[:4]:
            card = card_of(page, text)
            await expect(card).to_have_count(1)
            await expect(card.locator(".list td").get_by_text(text, exact=True)).to_have_count(1)
        for text in HOSTILE:
            await expect(page.locator(".cause").get_by_text(f"{text}.", exact=True)).to_have_count(1)
            await expect(page.locator("#past td").get_by_text(f"{text}. Remedy: {text}.", exact=True)).to_have_count(
                1
            )
        await expect(page).to_have_title(f"{HOSTILE[0]} - uavlinkd")
        made = await page.evaluate("document.querySelectorAll('img, iframe, main script, [onclick]').length")
        assert (made, await page.evaluate("window.ran")) == (0, None)
        await page.get_by_role("article").get_by_role("link", name=HOSTILE[0], exact=True).click()
        await expect(page.get_by_role("heading", level=1)).to_have_text(HOSTILE[0])
        await expect(page.get_by_role("article")).to_have_count(1)
        assert page.url.startswith(f"{web.url}peer/")
        assert await page.evaluate("window.ran") is None


@pytest.mark.long
async def test_a_button_copies_the_command_of_a_remedy(browser: Browser) -> None:
    """Without the backticks, which nothing on the page shows. A text with other signs than ASCII has no button, nor
    has a command for another machine.
    """
    daemon = await make_up(1)
    daemon.find(
        "drone1",
        "`a` is wrong",
        "run `uavlinkd pubkey` here, `x` here, `uavlinkd \u202eyekbup` here or `uavlinkd status` there",
    )
    async with page_of(daemon.answer) as web, window(browser, web.url) as page:
        await page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        problem = page.get_by_role("region", name="Problems", exact=True).get_by_role("listitem")
        await expect(problem).to_contain_text(
            "Remedy: run uavlinkd pubkey here, x here, uavlinkd \u202eyekbup here or"
        )
        button = problem.get_by_role("button")
        await expect(button).to_have_count(1)
        await button.click()
        await expect(button).to_have_text("Copieduavlinkd pubkey")
        assert await page.evaluate("navigator.clipboard.readText()") == "uavlinkd pubkey"
        await expect(button).to_have_text("Copyuavlinkd pubkey")
