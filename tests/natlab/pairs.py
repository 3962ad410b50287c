"""All pairs of kinds of places, and tables of what was measured between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Final

from tests.natlab.laboratory import Laboratory, Place

BEHIND_ONE_ROUTER: Final[Mapping[str, tuple[str, Callable[[Place], Place]]]] = {
    "one home": ("port-restricted", Place.housemate),
    "one carrier": ("carrier", Place.neighbour),
    "one carrier that hairpins": ("carrier-hairpin", Place.neighbour),
}
"""Pairs that share a router: the kind of the first, and how to place the second."""


IPV6_PAIRS: Final = (
    (("firewall", "symmetric"), (True, True)),
    (("symmetric", "carrier-symmetric"), (True, True)),
    (("carrier", "symmetric"), (True, True)),
    (("firewall", "full-cone"), (True, False)),
    (("symmetric", "carrier-symmetric"), (True, False)),
)
"""Kinds for IPv4, and which of the two places have IPv6."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two places, and the kinds that name them in a table. A pair behind one router has a name of its own."""

    kinds: tuple[str, str]
    places: tuple[Place, Place]
    name: str = ""

    @property
    def title(self) -> str:
        return self.name or " - ".join(self.kinds)


def make_pairs(
    laboratory: Laboratory, kinds: Sequence[str], *, delay_s: float = 0.0, loss: float = 0.0, shared: bool = True
) -> list[Pair]:
    """Two places of every kind, and all pairs of kinds between them; then those behind one router."""

    def place(kind: str) -> Place:
        return laboratory.place(kind, delay_s=delay_s, loss=loss)

    left, right = ({kind: place(kind) for kind in kinds} for _ in range(2))
    pairs = [Pair((a, b), (left[a], right[b])) for a, b in combinations_with_replacement(kinds, 2)]
    if shared:
        for name, (kind, second) in BEHIND_ONE_ROUTER.items():
            first = place(kind)
            pairs.append(Pair((kind, kind), (first, second(first)), name))
    return pairs


def make_ipv6_pairs(laboratory: Laboratory, *, delay_s: float = 0.0, loss: float = 0.0) -> list[Pair]:
    """Pairs of which both or one have IPv6, which is behind a firewall."""
    pairs = []
    for kinds, have_ipv6 in IPV6_PAIRS:
        one, other = (
            laboratory.place(kind, delay_s=delay_s, loss=loss, has_ipv6=has_ipv6)
            for kind, has_ipv6 in zip(kinds, have_ipv6, strict=True)
        )
        titles = [f"{kind}{' with IPv6' * has}" for kind, has in zip(kinds, have_ipv6, strict=True)]
        pairs.append(Pair(kinds, (one, other), " - ".join(titles)))
    return pairs
