"""The start of a daemon, measured by processor time beside that of its libraries: a ratio holds on any machine."""

from __future__ import annotations

import pytest

from tests.bench.start import libraries_seconds, started

STARTS = 7
MOST = 3.4
"""The start until a frame passes, as a multiple of an interpreter that imports asyncio and a key of cryptography."""
MOST_RESIDENT = 53_000_000


@pytest.mark.long
@pytest.mark.alone
def test_a_start_is_short_and_small() -> None:
    """The best of several, in turn: other work on the machine only adds."""
    with started() as pair:
        pair.start()  # writes the bytecode
        starts, libraries = zip(*((pair.start(), libraries_seconds()) for _ in range(STARTS)), strict=True)
    assert min(start.cpu_s for start in starts) <= MOST * min(libraries)
    assert max(start.rss for start in starts) <= MOST_RESIDENT
