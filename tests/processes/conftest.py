"""Fixtures of the tests with real daemons."""

from __future__ import annotations

import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from tests.processes.harness import Stage


@pytest.fixture
async def stage() -> AsyncIterator[Stage]:
    """Ends the daemons of a test, and searches their output for tracebacks and secrets."""
    async with Stage() as stage:
        yield stage


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """An empty folder whose path is short: that of a Unix socket in it has at most 107 bytes."""
    with tempfile.TemporaryDirectory(prefix="demo-") as folder:
        yield Path(folder)
