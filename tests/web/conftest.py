"""Fixtures of the tests of the page."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
from playwright.async_api import Browser

from tests.web.browser import open_browser
from tests.web.served import HASH, Served, page_of


@pytest.fixture
async def page() -> AsyncIterator[Served]:
    """A page without a password."""
    async with page_of() as page:
        yield page


@pytest.fixture
async def locked() -> AsyncIterator[Served]:
    """A page with a password, which also has a name."""
    async with page_of(password_hash=HASH, names=frozenset({"links.example"})) as page:
        yield page


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def browser() -> AsyncIterator[Browser]:
    """One Chromium for the tests of a file. These need the mark ``asyncio(loop_scope="module")``."""
    async with open_browser() as browser:
        yield browser
