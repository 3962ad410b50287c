"""The stage on which daemons play, for every test of this folder."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from tests.daemon.harness import Stage


@pytest.fixture
async def stage() -> AsyncIterator[Stage]:
    """Ends the daemons of a test, and looks for tracebacks and secrets in all that they said."""
    async with Stage() as stage:
        yield stage
