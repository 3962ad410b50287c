"""Fixtures of the tests with relays as processes."""

from tests.processes.conftest import stage

__all__ = ["stage"]
