"""New keys at full traffic: make before break."""

from __future__ import annotations

from functools import partial

import pytest

from tests.network.network import Drone, Network, share_a_session
from uavlinkd.core.settings import Link, Timers
from uavlinkd.lab.mitm.radio import RadioSettings

EVERY_2_S = Link(timers=Timers(rekey_after_s=2.0, reject_after_s=6.0))


def _want_new_keys(drone: Drone, other: Drone) -> None:
    """Make a drone ask for new keys now, as if the session that it sends on were old."""
    session = drone.session(other)
    assert drone.node is not None
    assert session is not None
    session.created_at -= 1000.0
    peer = drone.peer(other)
    drone.node.set_paths(peer, peer.paths.configured, drone.local_now)  # looks at its timers


@pytest.mark.parametrize(
    "delay_s", [*(pytest.param(delay_s, marks=pytest.mark.long) for delay_s in (0.0, 0.02)), 0.3]
)
@pytest.mark.parametrize("at_once", [False, True], ids=["in turn", "both at once"])
def test_rekeying_at_full_traffic_loses_and_reorders_nothing(delay_s: float, at_once: bool) -> None:
    """500 frames a second in each direction, new keys every two seconds or less: no loss, no reordering."""
    with Network(f"rekey {delay_s} {at_once}", RadioSettings(delay_s=delay_s)) as network:
        a, b = network.pair(EVERY_2_S)
        network.run_until(lambda: share_a_session(a, b), within_s=3)
        network.run(1)
        begin = network.now
        flows = network.talk(a, b, interval_s=0.002)
        for number in range(1, 10) if at_once else ():
            for drone, other in ((a, b), (b, a)):
                network.at(begin + 1.8 * number, partial(_want_new_keys, drone, other))
        network.run(18)
        for flow in flows:
            assert not flow.lost(until=network.now - delay_s - 0.01)
            assert flow.overtaken == 0
        for drone in (a, b):
            times = {round(at, 1) for at, _ in drone.established() if at > begin}
            assert len(times) >= 6
            # With a round trip longer than the first retry, a second response arrives after the first one, and
            # an echo request about a session that two others have replaced.
            assert set(drone.drops) <= ({"unexpected_response", "late"} if delay_s == 0.3 else set()), drone.drops
            assert drone.drops["late"] <= 2
