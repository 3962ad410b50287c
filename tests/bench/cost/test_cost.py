"""A frame costs no more than it did, by counts that do not depend on the machine's load."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.cost.count import count, missing_tools
from tests.needs import need

MOST_INSTRUCTIONS = 110_000
"""Of CPython 3.11 built without optimisations; with those of a distribution it is a fifth less."""
MOST_LINES = 3_500


@pytest.mark.long
def test_a_frame_costs_no_more_than_it_did(tmp_path: Path) -> None:
    """At each end, in user space."""
    need(not missing_tools(), "valgrind and gcc")
    for side, cost in count(tmp_path).items():
        assert 0 < cost.instructions < MOST_INSTRUCTIONS, side
        assert 0 < cost.lines < MOST_LINES, side
