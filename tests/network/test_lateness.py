"""An attacker delays authentic datagrams: no stale frame is delivered, and honest links lose nothing."""

from __future__ import annotations

import os
from functools import partial

import pytest

from tests.lab.mitm.middle import Middle
from tests.network.network import Flow, Network, every_second_may_be_old, share_a_session
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.settings import Link, Timers

VOUCHED_S = c.LATE_AFTER_S + 2 * c.LATE_STEP_S + c.HOLD_S
"""if the peer had to confirm it,"""
EVER_S = VOUCHED_S + c.LATE_AFTER_S
"""and in any combination: confirmed, then overtaken for the longest time."""
VERIFIED_S = c.LATE_AFTER_S + c.HOLD_S
"""How long after its request an answer verifies the frames that follow in order."""
SEEDS = int(os.environ.get("UAVLINKD_CHAOS_SEEDS", "2"))
"""Number of random histories of delays."""


def ages(flow: Flow) -> list[float]:
    return [at - flow.sent_at[number] for number, at in flow.delivered.items()]


@pytest.mark.parametrize(("hold_s", "interval_s"), [(2.5, 0.02), (2.5, 1.0), (5.0, 0.3), (20.0, 0.3)])
def test_a_recorded_blackout_delivers_nothing_stale(hold_s: float, interval_s: float) -> None:
    """Everything is held and released at once: only recent frames are delivered, and the link continues."""
    with Network(f"hold all {hold_s} {interval_s}", RadioSettings(delay_s=0.02)) as network:
        middle, a, b = Middle.between(network)
        flows = network.talk(a, b, interval_s)
        network.run(3)
        begin = network.now
        text = f"hold,kinds=any,hold_s={hold_s},seconds={hold_s}"
        middle.attack(parse_attack(text).make(middle.context, 1, begin))
        network.run(hold_s)
        freed = network.now
        network.run(hold_s + 5)
        for flow in flows:
            assert max(ages(flow)) < VOUCHED_S
            assert flow.first_delivery(freed) - freed < 2.0
            assert not flow.lost(freed + 1.5, network.now - 0.2)
        assert a.drops["delayed"] + a.drops["late"] > 0
        assert b.drops["delayed"] + b.drops["late"] > 0


@pytest.mark.parametrize("seed", range(SEEDS))
def test_no_combination_of_delays_delivers_stale_frames(seed: int) -> None:
    """Random delays of all lengths and shares, one after the other, over changes of keys and restarts."""
    with Network(f"held by lot {seed}", RadioSettings(delay_s=0.03, loss=0.1, reordering=0.1)) as network:
        rekeys = Link(timers=Timers(rekey_after_s=1.0, reject_after_s=20.0))
        middle, a, b = Middle.between(network, rekeys if seed % 2 else Link())
        lot = network.rng
        flows = network.talk(a, b, lot.choice((0.05, 0.4, 1.5, 4.0)))
        for round_number in range(8):
            specs = [
                f"hold,kinds={lot.choice(('any', 'envelope', 'handshake'))},share={lot.choice((0.1, 0.5, 1.0))}"
                f",hold_s={lot.uniform(0.5, 12):.2f},seconds={lot.uniform(0.5, 4):.2f}"
                for _ in range(2)
            ]
            middle.attack(*(parse_attack(spec).make(middle.context, round_number, network.now) for spec in specs))
            network.run(lot.uniform(3, 14))
            if lot.random() < 0.2:
                b.start(0.0)
        middle.attack()
        network.run(5)
        for flow in flows:
            assert flow.delivered
            assert max(ages(flow)) < EVER_S
        network.run_until(partial(share_a_session, a, b), within_s=2)


@pytest.mark.parametrize(("interval_s", "delay_s"), [(1.9, 0.45), (2.1, 0.2), (4.0, 0.005), (9.0, 0.45)])
def test_honest_links_with_rare_frames_lose_nothing(interval_s: float, delay_s: float) -> None:
    """Rare frames with silence between them: each is delivered, after another round trip if the sender is asked."""
    with Network(f"slow talk {interval_s} {delay_s}", RadioSettings(delay_s=delay_s, jitter_s=0.01)) as network:
        a, b = network.pair()
        network.run_until(partial(share_a_session, a, b), within_s=5)
        network.run(5)
        begin = network.now
        flow = network.traffic(a, b, interval_s)  # b says nothing at all
        network.run(60)
        assert not flow.lost(begin, network.now - 2)
        assert max(ages(flow)) < 3 * (delay_s + 0.011)
        assert b.drops["delayed"] == b.drops["doubtful"] == 0


def test_a_one_way_link_that_never_fell_silent_keeps_delivering_reports() -> None:
    """The other direction carries no answer: reports need none, and frames that must be new are dropped."""
    with Network("one way", RadioSettings(delay_s=0.05)) as network:
        network.screen = every_second_may_be_old
        a, b = network.pair()
        flow = network.traffic(a, b, 0.75)
        network.run(4)
        begin = network.now
        network.cuts.add(("b", "a"))
        network.run(100)
        assert {number % 2 for number in flow.lost(begin + VERIFIED_S, network.now - 0.2)} == {0}
        assert b.drops["doubtful"] > 0
