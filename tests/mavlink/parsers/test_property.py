"""For any delivered stream: policy passes each frame that a real parser accepts, from the senders of its bytes."""

from __future__ import annotations

import pytest

from tests.mavlink.parsers.judge import unfiltered
from tests.mavlink.parsers.run import run

STREAMS = 6000


@pytest.mark.long
def test_no_receiver_accepts_what_policy_forbids() -> None:
    """From any offset and after a random loss; the streams cover every step of the parsers."""
    result = run(STREAMS, seed=15, share=4)
    assert not result.breaches_by_receiver, "\n".join(result.lines())
    assert not result.missing_steps
    assert result.verdicts.counts["truncated"] == 0
    assert result.counts["refused"] > STREAMS // 100
    assert result.counts["separators"] > STREAMS // 100
    assert result.verdicts.counts["harmless"] > 0


@pytest.mark.long
def test_streams_are_dangerous() -> None:
    """Without the filter the same streams make receivers accept forbidden frames."""
    result = run(500, seed=15, make=unfiltered, share=4)
    assert sum(result.breaches_by_receiver.values()) > 100
