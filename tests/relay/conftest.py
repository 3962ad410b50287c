"""Fixtures of the tests with relays as processes."""

from tests.daemon.conftest import stage

__all__ = ["stage"]
