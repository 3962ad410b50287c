"""These tests build receivers: they need a C compiler."""

from __future__ import annotations

import pytest

from tests.mavlink.parsers.receivers import compiler


@pytest.fixture(scope="session", autouse=True)
def cc() -> str:
    """The C compiler."""
    path = compiler()
    if path is None:
        pytest.skip("needs a C compiler (cc) to build MAVLink's parsers")
    return path
