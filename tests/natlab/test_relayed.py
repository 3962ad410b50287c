"""Daemons behind NATs that ICE cannot connect reach each other through a relay."""

from __future__ import annotations

import pytest

from tests.natlab import daemons, namespaces
from tests.natlab.laboratory import Laboratory
from tests.natlab.pairs import make_pairs
from tests.needs import need
from tests.waiting import Stopwatch

pytestmark = pytest.mark.alone
KINDS = ("symmetric", "carrier-symmetric")
RELAYED_S = 1.0
"""From when both reached the relay until each has received a frame."""


async def test_every_pair_is_relayed() -> None:
    """Soon, and without the loss of a frame from then on."""
    reason = namespaces.why_not()
    need(reason is None, reason or "")
    watch = Stopwatch()

    with Laboratory() as laboratory:
        pairs = make_pairs(laboratory, KINDS, shared=False)
        outcomes = await daemons.connect_all(pairs, laboratory.public(), direct_limit_s=0, at_once=2)

    print(outcomes)
    for outcome in outcomes.values():
        assert outcome.relayed_s is not None
        assert outcome.relayed_s < RELAYED_S + watch.contended_s
        assert outcome.lost == 0
