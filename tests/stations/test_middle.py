"""A man in the middle between the real wireguard-go and the daemon delays, holds and replays its datagrams."""

from __future__ import annotations

from collections.abc import Iterator
from time import monotonic

import pytest

from tests.stations.middle import Middle
from tests.stations.scene import Scene, need_wireguard, until
from tests.waiting import Stopwatch

pytestmark = pytest.mark.long
OLDEST_S = 5.5
"""The bound of the age of a command, as for peers."""
BACK_S = 0.5
REFUSING = "table inet tablet { chain in { type filter hook input priority 0; icmp type echo-request drop; }; }"


@pytest.fixture
def middle() -> Iterator[Middle]:
    need_wireguard()
    with Scene() as scene:
        middle = Middle(scene)
        yield middle
        middle.close()


def until_commands(middle: Middle) -> None:
    """Run until a command arrives that is sent from now on."""
    first = len(middle.sent)

    def arrives() -> bool:
        middle.run(0.05)
        return any(arrival.number >= first for arrival in middle.arrivals)

    until(arrives, "commands pass")


@pytest.mark.parametrize("delay_s", [1.0, 4.0, 8.0, 30.0])
@pytest.mark.parametrize("answers", [True, False])
def test_delayed_commands_are_new_or_dropped(middle: Middle, delay_s: float, *, answers: bool) -> None:
    """None is older than the bound, none comes twice, and they are back soon after the delay ends."""
    printed = middle.scene.add("tablet")
    if not answers:
        middle.scene.tablet.nft(REFUSING)
    middle.scene.start_daemon()
    middle.open(printed)
    until_commands(middle)
    middle.run(3.0)
    middle.delay_s = delay_s
    middle.run(delay_s + 4.0)
    middle.delay_s, released_at, released = 0.0, monotonic(), Stopwatch()
    first = len(middle.sent)
    until_commands(middle)
    back_s = next(arrival.at for arrival in middle.arrivals if arrival.number >= first) - released_at
    calm_s = released.calm_s
    middle.run(2.0)
    middle.replay()
    middle.run(2.0)
    oldest = max(middle.arrivals, key=lambda arrival: arrival.age_s)
    print(f"answers {answers}, delay {delay_s} s: oldest {oldest.age_s:.2f} s, back after {back_s:.2f} s")
    assert max(arrival.calm_s for arrival in middle.arrivals) <= OLDEST_S
    assert len({arrival.number for arrival in middle.arrivals}) == len(middle.arrivals)
    assert calm_s <= BACK_S
