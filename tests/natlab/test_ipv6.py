"""Daemons with IPv6 behind firewalls become direct over it, whatever NATs they have for IPv4."""

from __future__ import annotations

import pytest

from tests.natlab import daemons, namespaces
from tests.natlab.laboratory import Laboratory
from tests.natlab.pairs import make_ipv6_pairs
from tests.needs import need

pytestmark = [pytest.mark.alone, pytest.mark.long]
DIRECT_S = 10.0


async def test_pairs_with_ipv6_are_direct_over_it() -> None:
    """A firewall drops what it did not ask for. If one end has no IPv6, the NATs for IPv4 decide."""
    reason = namespaces.why_not()
    need(reason is None, reason or "")

    with Laboratory() as laboratory:
        pairs = make_ipv6_pairs(laboratory)
        outcomes = await daemons.connect_all(
            pairs, laboratory.public(has_ipv6=True), direct_limit_s=DIRECT_S, at_once=2
        )

    print({pair.title: outcome for pair, outcome in outcomes.items()})
    assert all(outcome.relayed_s is not None for outcome in outcomes.values())
    for pair, outcome in outcomes.items():
        one, other = pair.places
        if one.ipv6 and other.ipv6:
            assert outcome.direct_to.startswith(f"[{other.ipv6}]:")
        elif other.kind == "full-cone":
            assert outcome.direct_to.startswith(f"{other.external}:")
        else:
            assert outcome.direct_s is None
