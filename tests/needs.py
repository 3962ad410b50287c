"""Skips a test without what it needs. In CI all tools are installed, and then a skip is a failure.

``python -m tests.needs`` reads the output of pytest and prints the skips that are failures in CI. Status 1: some are.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import pytest

MAY_BE_MISSING = (
    "no ProVerif",
    "no recorded flights",
    "no autopilot simulator",
    "needs a writable cgroup",
    "needs minutes of emulation",
    "needs an interface with a link-local IPv6 address",
    "this machine does not know its own name",
)
"""How the reasons begin for which a test may be skipped in CI too: see tests/README.md."""


def need(is_there: bool, what: str) -> None:
    """Skip a test without what it needs; in CI that is a failure (tests/conftest.py)."""
    if not is_there:
        pytest.skip(f"needs {what}")


def forbidden_skips(lines: Iterable[str]) -> list[str]:
    """The lines ``SKIPPED [2] file:line: reason`` of pytest's summary, except those whose reason is allowed in CI."""
    skips = [line.rstrip() for line in lines if line.startswith("SKIPPED ")]
    return [skip for skip in skips if not skip.partition(": ")[2].startswith(MAY_BE_MISSING)]


if __name__ == "__main__":
    failures = forbidden_skips(sys.stdin)
    print(*failures, sep="\n")
    sys.exit(bool(failures))
