"""Frames of every kind between the two ends, restarts and an attacker, judged by MAVLink's C library."""

from __future__ import annotations

import pytest

from tests.conftest import EXAMPLES
from tests.mavlink.parsers.receivers import compiler
from tests.mavlink.signing.storm import run

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler (cc) to build MAVLink's parsers")


@pytest.mark.parametrize("is_ordered", [True, False], ids=["cable", "network"])
@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_nothing_replayed_or_unsigned_counts(kind: str, *, is_ordered: bool) -> None:
    """No frame in order is rejected, and none of the attacker's is accepted, over restarts of either end."""
    storm = run(kind, 1000 * EXAMPLES, EXAMPLES, is_ordered=is_ordered)
    assert not storm.faults
    assert storm.counts["restarts of the autopilot"] >= 5
    assert storm.counts["daemon: passed"] > 200 * EXAMPLES
    assert storm.counts["autopilot: accepted"] > 200 * EXAMPLES
    assert storm.slowest_s < 1.5
