"""Links are soon back: after a restart without state and with another clock, and after a blackout."""

from __future__ import annotations

from functools import partial

import pytest

from tests.network.network import Address, Drone, Network, share_a_session
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.outputs import PeerLost

BACK_WITHIN_S = 2.0
CLOCKS = {"zero": 0.0, "2106": 2.0**32 + 0.25}


def _assert_both_hear_within(network: Network, a: Drone, b: Drone, bound_s: float) -> None:
    """Frames sent from now on are delivered at both ends within the bound, and continue to be."""
    begin = network.now
    network.run(bound_s)
    for flow in (network.flow(a, b), network.flow(b, a)):
        assert flow.first_delivery(begin) <= begin + bound_s, f"{flow.sender} to {flow.receiver} is silent"
    network.run(3)
    assert share_a_session(a, b)
    for flow in (network.flow(a, b), network.flow(b, a)):
        assert not flow.lost(begin + bound_s, network.now - 1)


@pytest.mark.parametrize("clock", CLOCKS.values(), ids=CLOCKS)
@pytest.mark.parametrize("delay_s", [0.0, 0.1])
@pytest.mark.parametrize("who_knows", ["both", "restarted", "other"])
def test_link_is_back_after_a_restart_without_state(who_knows: str, delay_s: float, clock: float) -> None:
    """One end restarts with only its key and another clock: frames cross again within two seconds."""
    for seed in range(2):
        with Network(f"restart {who_knows} {delay_s} {clock} {seed}", RadioSettings(delay_s=delay_s)) as network:
            a, b = network.linked(a_knows=who_knows != "other", b_knows=who_knows != "restarted")
            network.run(network.rng.random())
            a.start(clock)
            _assert_both_hear_within(network, a, b, BACK_WITHIN_S)


STALE: tuple[Address, ...] = (("192.0.2.1", 5790), ("192.0.2.2", 5790), ("192.0.2.3", 5790))


@pytest.mark.parametrize(
    ("blackout_s", "interval_s", "stale"), [(1, 0.02, 3), (3, 0.25, 0), (10, 0.02, 3), (60, 0.25, 0), (200, 0.25, 3)]
)
def test_frames_cross_within_two_seconds_of_a_blackout(blackout_s: float, interval_s: float, stale: int) -> None:
    """Everything is lost for a second, or for longer than keys live: 2 s later frames cross in both directions.

    ``stale``: addresses that each end has beside the right one.
    """
    with Network(f"blackout {blackout_s} {interval_s} {stale}", RadioSettings(delay_s=0.1)) as network:
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
            losses = [at for one in (a, b) for at, event in one.outputs if at > begin and isinstance(event, PeerLost)]
            assert len(losses) == (2 if blackout_s > 3 else 0)
        network.run(BACK_WITHIN_S)
        for flow in flows:
            assert flow.first_delivery(end - 0.1) < network.now, f"{flow.sender} to {flow.receiver}"
        recovered = network.now
        network.run(3)
        assert share_a_session(a, b)
        for flow in flows:
            assert not flow.lost(recovered, network.now - 0.2)
