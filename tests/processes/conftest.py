"""Fixtures of the tests with real daemons."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from tests.processes.harness import Stage


@pytest.fixture
async def stage() -> AsyncIterator[Stage]:
    """Ends the daemons of a test, and searches their output for tracebacks and secrets."""
    async with Stage() as stage:
        yield stage
