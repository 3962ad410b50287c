"""Daemons behind NATs: relayed, direct over IPv6, and faults after which the link is back."""

from __future__ import annotations

import asyncio

import pytest

from tests.natlab import daemons
from tests.natlab.faults import FAULTS, Outcome, play
from tests.natlab.laboratory import Laboratory, need_laboratory
from tests.natlab.pairs import make_ipv6_pairs, make_pairs
from tests.waiting import Stopwatch

pytestmark = [pytest.mark.alone, pytest.mark.usefixtures("_needs")]

RELAYED_S = 1.0
"""From when both reached the relay until each has received a frame."""
DIRECT_S = 10.0
AT_ONCE = 4
BACK_S = 2.0
MOVED_S = 4.0
"""A relay at another address is lost first; then its name is resolved, once a second."""


@pytest.fixture(scope="module")
def _needs() -> None:
    need_laboratory()


async def test_every_pair_is_relayed() -> None:
    """Also those that are never direct; soon, and without the loss of a frame from then on."""
    watch = Stopwatch()
    with Laboratory() as laboratory:
        pairs = make_pairs(laboratory, ("symmetric", "carrier-symmetric"), shared=False)
        outcomes = await daemons.connect_all(pairs, laboratory.public(), direct_limit_s=0, at_once=2)
    for outcome in outcomes.values():
        assert outcome.relayed_s is not None
        assert outcome.relayed_s < RELAYED_S + watch.contended_s
        assert outcome.lost == 0


async def test_pairs_with_ipv6_are_direct_over_it() -> None:
    """A firewall drops what it did not ask for. If one end has no IPv6, the NATs for IPv4 decide."""
    with Laboratory() as laboratory:
        pairs = make_ipv6_pairs(laboratory)
        public = laboratory.public(has_ipv6=True)
        outcomes = await daemons.connect_all(pairs, public, direct_limit_s=DIRECT_S, at_once=2)
    for pair, outcome in outcomes.items():
        one, other = pair.places
        assert outcome.relayed_s is not None
        if one.ipv6 and other.ipv6:
            assert outcome.direct_to.startswith(f"[{other.ipv6}]:")
        elif other.kind == "full-cone":
            assert outcome.direct_to.startswith(f"{other.external}:")
        else:
            assert outcome.direct_s is None


async def test_link_is_back_soon_after_each_fault() -> None:
    """Frames are lost meanwhile, but no critical one if one of two networks dies, and 2 % at most if a NAT forgets.

    The faults happen at the same time, each in a laboratory of its own: mostly they wait.
    """
    watch, turns = Stopwatch(), asyncio.Semaphore(AT_ONCE)

    async def happen(fault: str) -> Outcome:
        async with turns:
            with Laboratory() as laboratory:
                return await play(FAULTS[fault], laboratory)

    outcomes = dict(zip(FAULTS, await asyncio.gather(*map(happen, FAULTS)), strict=True))
    for fault, outcome in outcomes.items():
        print(fault, outcome)
        assert outcome.back_s < (MOVED_S if "address" in fault else BACK_S) + watch.contended_s, fault
        if "critical frames" in fault:
            assert outcome.sent > 100
            # A question that passes a NAT in the instant in which it forgets costs one more round trip.
            assert outcome.lost <= (0.02 * outcome.sent if fault.startswith("the same") else 0)
        else:
            assert 0 < outcome.lost < outcome.sent, fault
