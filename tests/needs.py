"""Skips a test that lacks what it needs."""

from __future__ import annotations

import pytest


def need(is_there: bool, what: str) -> None:
    """Skip a test without what it needs; in CI that is a failure (tests/conftest.py)."""
    if not is_there:
        pytest.skip(f"needs {what}")
