"""An attacker delays authentic datagrams: no stale frame is delivered, and honest links lose nothing."""

from __future__ import annotations

import os
from functools import partial

import pytest

from tests.lab.mitm.middle import Middle
from tests.network.network import Flow, Network, every_second_may_be_old, share_a_session
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.attacks.withholding import Reorder
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.settings import Link, Timers

OVERTAKEN_S = c.LATE_AFTER_S + 2 * c.LATE_STEP_S
"""The maximum age of a delivered frame if later ones arrived all the time,"""
VOUCHED_S = c.LATE_AFTER_S + 2 * c.LATE_STEP_S + c.HOLD_S
"""if the peer had to confirm it,"""
EVER_S = VOUCHED_S + c.LATE_AFTER_S
"""and in any combination: confirmed, then overtaken for the longest time."""
VERIFIED_S = c.LATE_AFTER_S + c.HOLD_S
"""How long after its request an answer verifies the frames that follow in order."""
SEEDS = int(os.environ.get("UAVLINKD_CHAOS_SEEDS", "2"))
"""Number of random histories of delays."""
REKEYS = Link(timers=Timers(rekey_after_s=1.0, reject_after_s=20.0))
PLAIN = Link()


def ages(flow: Flow) -> list[float]:
    return [at - flow.sent_at[number] for number, at in flow.delivered.items()]


@pytest.mark.parametrize("link", [PLAIN, REKEYS], ids=["one session", "rekeys"])
@pytest.mark.parametrize("hold_s", [1.0, 30.0])
def test_overtaken_envelopes_are_delivered_in_time_or_never(hold_s: float, link: Link) -> None:
    """A fifth of all is held: up to two seconds late it is delivered, later it is refused as delayed."""
    with Network(f"hold some {hold_s}", RadioSettings(delay_s=0.02)) as network:
        middle, a, b = Middle.between(network, link)
        flows = network.talk(a, b)
        network.run(2)
        begin = network.now
        text = f"hold,share=0.2,hold_s={hold_s},seconds=8"
        middle.attack(parse_attack(text).make(middle.context, 1, begin))
        network.run(8 + hold_s + 3)
        for flow in flows:
            assert max(ages(flow)) < OVERTAKEN_S
            lost = flow.lost(begin, network.now - 3)
            assert bool(lost) == (hold_s > c.LATE_AFTER_S)
            assert len(lost) < 0.4 * 8 / 0.05
        if hold_s > OVERTAKEN_S:
            # For empty, ended sessions the peer is asked; its answer is the same.
            assert min(drone.drops["delayed"] + drone.drops["late"] for drone in (a, b)) > 10
        assert share_a_session(a, b)


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
        middle, a, b = Middle.between(network, REKEYS if seed % 2 else PLAIN)
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


@pytest.mark.parametrize(("depth", "patience_s"), [(8, 0.5), (40, 0.9)])
def test_reordering_within_two_seconds_loses_nothing(
    monkeypatch: pytest.MonkeyPatch, depth: int, patience_s: float
) -> None:
    """In any order: a delay of up to two seconds is in time."""
    monkeypatch.setattr(Reorder, "depth", depth)
    monkeypatch.setattr(Reorder, "patience_s", patience_s)
    with Network(f"reorder {depth}", RadioSettings(delay_s=0.02)) as network:
        middle, a, b = Middle.between(network)
        flows = network.talk(a, b, 0.02)
        network.run(2)
        begin = network.now
        middle.attack(parse_attack("reorder,seconds=10").make(middle.context, 1, begin))
        network.run(15)
        for flow, receiver, sender in ((flows[0], b, a), (flows[1], a, b)):
            assert flow.overtaken > 50
            assert not flow.lost(begin, network.now - 0.1)
            assert receiver.peer(sender).traffic.out_of_order > 50
            assert receiver.peer(sender).missing(receiver.local_now) == 0
            assert receiver.drops["delayed"] == receiver.drops["doubtful"] == 0


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
