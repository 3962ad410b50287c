"""Links that lose everything for a while."""

from __future__ import annotations

from functools import partial

import pytest

from tests.network.network import Address, Network, share_a_session
from uavlinkd.core.outputs import PeerLost
from uavlinkd.lab.mitm.radio import RadioSettings

BACK_WITHIN_S = 2.0
STALE: tuple[Address, ...] = (("192.0.2.1", 5790), ("192.0.2.2", 5790), ("192.0.2.3", 5790))


@pytest.mark.parametrize(
    "stale", [pytest.param(0, marks=pytest.mark.long), 3], ids=["one address", "three stale addresses more"]
)
@pytest.mark.parametrize(
    ("blackout_s", "interval_s"), [(1, 0.02), (1, 0.25), (3, 0.02), (3, 0.25), (10, 0.02), (60, 0.25), (200, 0.25)]
)
def test_frames_cross_within_two_seconds_of_a_blackout(blackout_s: float, interval_s: float, stale: int) -> None:
    """Everything is lost for a second, or for longer than keys live: 2 s later frames cross in both directions."""
    name = f"blackout {blackout_s} {interval_s} {stale}"
    for seed in range(3):
        with Network(f"{name} {seed}", RadioSettings(delay_s=0.1)) as network:
            a, b = network.add("a"), network.add("b", clock=77.7)
            a.knows(b, [*STALE[:stale], *b.addresses])
            b.knows(a, [*a.addresses, *STALE[:stale]])
            a.start()
            b.start()
            flows = network.talk(a, b, interval_s)
            network.run_until(partial(share_a_session, a, b), within_s=3)
            network.run(5 + network.rng.random())
            network.cut(a, b)
            begin = network.now
            network.run(blackout_s)
            network.cuts.clear()
            end = network.now
            if blackout_s != 3:  # the limit itself
                losses = [
                    at for one in (a, b) for at, event in one.outputs if at > begin and isinstance(event, PeerLost)
                ]
                assert len(losses) == (2 if blackout_s > 3 else 0)
            network.run(BACK_WITHIN_S)
            for flow in flows:
                assert flow.first_delivery(end - 0.1) < network.now, f"{flow.sender} to {flow.receiver}"
            recovered = network.now
            network.run(3)
            assert share_a_session(a, b)
            for flow in flows:
                assert not flow.lost(recovered, network.now - 0.2)
