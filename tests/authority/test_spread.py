"""How fast a bulletin reaches all members, and what holds in any history of links, restarts and disks."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations
from typing import Any
from unittest.mock import ANY

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.authority.signing import bulletin
from tests.authority.simulation import SimulatedFleet, key_of
from uavlinkd.authority.constants import HAVE_INTERVAL_S

MEMBERS = 50
NEW = bulletin(2, 101, 102, 103)
MESH = tuple(combinations(range(1, MEMBERS + 1), 2))
STAR = tuple((1, other) for other in range(2, MEMBERS + 1))
LINE = tuple((number, number + 1) for number in range(1, MEMBERS))


@pytest.mark.parametrize(
    ("links", "loss", "within_s", "most_kb"),
    [
        pytest.param(MESH, 0.0, 0.1, 300, id="mesh"),
        pytest.param(MESH, 0.3, 0.15, 500, id="mesh, 30 %"),
        pytest.param(STAR, 0.0, 0.13, 15, id="star"),
        pytest.param(STAR, 0.1, 0.8, 20, id="star, 10 %"),
        pytest.param(STAR, 0.3, 1.5, 30, id="star, 30 %"),
        pytest.param(LINE, 0.0, 4.0, 15, id="line"),
        pytest.param(LINE, 0.1, 6.5, 20, id="line, 10 %"),
        pytest.param(LINE, 0.3, 11.5, 30, id="line, 30 %"),
    ],
)
def test_last_of_fifty_members_has_it(
    links: Iterable[tuple[int, int]], loss: float, within_s: float, most_kb: int
) -> None:
    """Round trips of 40 ms. Once all have it, nothing more is sent."""
    fleet = SimulatedFleet(MEMBERS, seed=1)
    for one, other in links:
        fleet.link(one, other)
    fleet.run(1.0)
    fleet.loss, fleet.bytes_sent = loss, 0
    fleet.publish(1, NEW)
    assert fleet.run(60.0, lambda: set(fleet.newest()) == {2}) <= within_s
    fleet.run(60.0)
    assert fleet.bytes_sent <= 1000 * most_kb
    fleet.loss, fleet.bytes_sent = 0.0, 0
    fleet.run(60.0)
    assert fleet.bytes_sent == 0
    for member in fleet.members.values():
        assert all(member.exchange.shown(key_of(other)) == 2 for other in member.up)


SIZE = 5
PAIRS = tuple(combinations(range(1, SIZE + 1), 2))
COPIES = tuple(
    {number: bulletin(number, *sorted({101 + copy, *(2 + copy, 4)[: number // 4]})) for number in range(2, 9)}
    for copy in (0, 1)
)
"""Of two copies of the authority that do not know of each other. Each revokes one or two members."""

UNION = bulletin(9, 2, 3, 4, 101, 102)

STEPS = st.one_of(
    st.tuples(st.just("connect"), st.sampled_from(PAIRS)),
    st.tuples(st.just("disconnect"), st.sampled_from(PAIRS), st.booleans()),
    st.tuples(st.just("restart"), st.integers(1, SIZE), st.booleans(), st.booleans()),
    st.tuples(st.just("keep a copy of the disk"), st.integers(1, SIZE)),
    st.tuples(st.just("disk full"), st.integers(1, SIZE)),
    st.tuples(st.just("publish"), st.integers(1, SIZE), st.sampled_from((0, 0, 0, 1)), st.integers(2, 8)),
    st.tuples(st.just("wait"), st.sampled_from((0.001, 0.03, 0.3, 0.3, 3.0))),
)


class History:
    """A fleet of five, to which anything happens. Each has a link with each in the beginning."""

    def __init__(self, seed: int) -> None:
        self.fleet = SimulatedFleet(SIZE, seed, is_reordered=True)
        self.connect_all()
        self.fleet.run(1.0)
        self.fleet.loss = (0.0, 0.1, 0.4)[seed % 3]

    def connect_all(self) -> None:
        """All that accept each other."""
        for pair in PAIRS:
            self.fleet.connect(*pair)

    def step(self, what: str, *arguments: Any) -> None:
        """One step. The fleet checks what always holds."""
        fleet = self.fleet
        match what, *arguments:
            case "connect", (one, other):
                fleet.connect(one, other)
            case "disconnect", (one, other), is_noticed:
                fleet.disconnect(one, other, is_noticed=is_noticed)
            case "restart", number, is_restored, is_noticed:
                fleet.restart(number, is_restored=is_restored, is_noticed=is_noticed)
            case "keep a copy of the disk", number:
                fleet.members[number].old_disk = fleet.members[number].disk
            case "disk full", number:
                fleet.members[number].is_writable = False
            case "publish", member, copy, number:
                fleet.publish(member, COPIES[copy][number])
            case _:
                fleet.run(arguments[0])

    def heal(self) -> None:
        """Every disk can be written, and all links are made. After half a minute they lose no more datagrams."""
        for number in self.fleet.members:
            self.fleet.repair_disk(number)
        self.connect_all()
        self.fleet.run(3 * HAVE_INTERVAL_S)
        self.fleet.loss = 0.0
        self.fleet.run(3 * HAVE_INTERVAL_S)

    def check_agreement(self) -> None:
        """All that are connected have one bulletin, know that of each other, and have written it."""
        for member in self.fleet.members.values():
            for other in member.up:
                assert self.fleet.members[other].trust.digest == member.trust.digest
                assert member.exchange.shown(key_of(other)) == member.trust.bulletin.number
            assert member.disk == member.trust.bulletin_bytes
        self.fleet.bytes_sent = 0
        self.fleet.run(3 * HAVE_INTERVAL_S)
        assert self.fleet.bytes_sent == 0, "they are not silent"


@given(st.integers(0, 10_000), st.lists(STEPS, max_size=30))
@settings(max_examples=100, deadline=None)
def test_any_history(seed: int, steps: list[tuple[Any, ...]]) -> None:
    """After it, all that are connected have the newest bulletin, or report that two copies of the authority disagree.

    The union of both bulletins, with a higher number, ends that. In the history, no *have* of a member falls, unless
    its disk was restored: then each peer that saw more reports it. No link exists whose serial an end has revoked.
    """
    history = History(seed)
    for step in steps:
        history.step(*step)
    history.heal()
    fleet = history.fleet
    for member in fleet.members.values():
        others = [fleet.members[other] for other in member.up]
        newest = max((other.trust.bulletin.number for other in others), default=0)
        if newest > member.trust.bulletin.number:
            assert (ANY, "bulletin_shrinks") in member.events
        if any(
            other.trust.bulletin.number == member.trust.bulletin.number
            for other in others
            if other.trust.digest != member.trust.digest
        ):
            assert (ANY, "bulletin_conflict") in member.events
    copies = {step[2] for step in steps if step[0] == "publish"}
    if len(copies) == 2:
        for number in fleet.members:
            fleet.publish(number, UNION)
        fleet.run(6 * HAVE_INTERVAL_S)
    history.check_agreement()
