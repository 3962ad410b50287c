"""An attacker forwards all envelopes in order, each later than the one before: frames that must be new stay new."""

from __future__ import annotations

import os
from functools import partial
from typing import NamedTuple

import pytest

from tests.lab.mitm.middle import Middle
from tests.network.network import Drone, Flow, Network, every_second_may_be_old, share_a_session
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.radio import Bursts, RadioSettings
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.settings import Link

pytestmark = pytest.mark.long

VERIFIED_S = c.LATE_AFTER_S + c.HOLD_S
"""The maximum age of a frame that must be new and arrives in order,"""
EVER_S = 2 * (c.LATE_AFTER_S + c.LATE_STEP_S) + c.HOLD_S
"""and in any order, with round trips below a second."""
SEEDS = int(os.environ.get("UAVLINKD_CHAOS_SEEDS", "6"))


ONE_EVERY_1_8_S = "direction=a>b,interval_s=1.8"
ATTACKS = {
    "handshakes blocked": f"stretch,{ONE_EVERY_1_8_S}",
    "answers dropped": f"stretch-one-way,{ONE_EVERY_1_8_S}",
    "other direction blocked": f"stretch-one-way,{ONE_EVERY_1_8_S},back=all",
    "handshakes pass": f"stretch,{ONE_EVERY_1_8_S},block_handshakes=false",
}


class Oldest(NamedTuple):
    """The greatest age in seconds of a frame that came out."""

    must_be_new: float
    may_be_old: float


def oldest(flow: Flow) -> Oldest:
    """Of the frames of either kind."""
    ages: tuple[list[float], list[float]] = [0.0], [0.0]
    for number, at in flow.delivered.items():
        ages[number % 2].append(at - flow.sent_at[number])
    return Oldest(*map(max, ages))


def stretched(attack: str, seconds: float, *, answers: bool = True, interval_s: float = 0.05) -> tuple[Flow, Drone]:
    """What came out at b while an attacker delays what a sends; without ``answers`` b only listens."""
    with Network(f"stretched {attack} {answers}", RadioSettings(delay_s=0.02)) as network:
        network.screen = every_second_may_be_old
        middle, a, b = Middle.between(network)
        flow = network.traffic(a, b, interval_s)
        if answers:
            network.traffic(b, a, interval_s)
        network.run(3)
        middle.attack(parse_attack(attack).make(middle.context, 1, network.now))
        network.run(seconds)
        return flow, b


@pytest.mark.parametrize("answers", [True, False], ids=["talks", "listens"])
@pytest.mark.parametrize("attack", ATTACKS)
def test_what_must_be_new_is_never_stretched(attack: str, answers: bool) -> None:
    """The attacks that once delivered commands up to 172 s old deliver none older than three seconds."""
    flow, receiver = stretched(ATTACKS[attack], 185.0, answers=answers)
    print(oldest(flow))
    assert oldest(flow).must_be_new < VERIFIED_S
    assert receiver.drops["doubtful"] > 0


@pytest.mark.parametrize("interval_s", [0.07, 0.1, 0.2, 0.3])
def test_no_pace_of_stretching_makes_it_older(interval_s: float) -> None:
    """The age in order has the same limit at any pace of the delay."""
    flow, _ = stretched(f"stretch-one-way,direction=a>b,interval_s={interval_s}", 30.0)
    assert 1.0 < oldest(flow).must_be_new < VERIFIED_S


def test_reports_over_a_blocked_direction_arrive_until_the_session_ends() -> None:
    """The remaining case: reports up to the age of a session. The receiver knows it after three seconds."""
    flow, _ = stretched(ATTACKS["other direction blocked"], 185.0)
    assert 160.0 < oldest(flow).may_be_old < c.REJECT_AFTER_S
    _, receiver = stretched(ATTACKS["other direction blocked"], c.LATE_AFTER_S + c.HOLD_S + 2 * 1.8)
    assert receiver.node is not None
    assert all(peer.unverified_since is not None for peer in receiver.node.peers.values())


@pytest.mark.parametrize("seed", range(SEEDS))
def test_no_combination_of_stretching_and_delays_delivers_stale_frames(seed: int) -> None:
    """Random paces, kinds of records and delays, one after the other."""
    with Network(f"stretched by lot {seed}", RadioSettings(delay_s=0.02, loss=0.05)) as network:
        network.screen = every_second_may_be_old
        middle, a, b = Middle.between(network)
        lot = network.rng
        flows = network.talk(a, b, lot.choice((0.05, 0.2, 0.9)))
        network.run(3)
        for number in range(12):
            direction, pace_s = lot.choice(("a>b", "b>a")), lot.choice((0.03, 0.1, 0.25, 1.0, 1.8))
            specs = [
                f"stretch-one-way,direction={direction},interval_s={pace_s}"
                f",share={lot.choice((0.2, 0.5, 1.0))},back={lot.choice(('echoes', 'all'))}"
                f",block_handshakes={lot.choice(('true', 'false'))}",
                f"hold,share={lot.choice((0.05, 0.3))},hold_s={lot.uniform(0.2, 3.0):.2f}",
            ]
            chosen = lot.sample(specs, lot.choice((1, 2)))
            middle.attack(*(parse_attack(spec).make(middle.context, number, network.now) for spec in chosen))
            network.run(lot.uniform(1.0, 12.0))
        middle.attack()
        network.run(5)
        for flow in flows:
            assert oldest(flow).must_be_new < EVER_S + c.HOLD_S
        network.run_until(partial(share_a_session, a, b), within_s=3)


@pytest.mark.parametrize("radio", ["clean", "random", "bursts"])
def test_honest_links_lose_no_frame_to_verification(radio: str) -> None:
    """At 50 ms ± 20 ms, with 30 % loss in each direction or none: every frame that arrives is delivered."""
    losses = {
        "clean": RadioSettings(delay_s=0.05, jitter_s=0.02),
        "random": RadioSettings(delay_s=0.05, jitter_s=0.02, loss=0.3),
        "bursts": RadioSettings(delay_s=0.05, jitter_s=0.02, bursts=Bursts(to_bad=0.086, to_good=0.2)),
    }
    with Network(f"honest {radio}", losses[radio]) as network:
        a, b = network.pair(Link())
        flows = network.talk(a, b)
        network.run_until(partial(share_a_session, a, b), within_s=30)
        network.run(120)
        for flow in flows:
            assert len(flow.delivered) > 1500
        for drone in (a, b):
            assert drone.drops["doubtful"] == drone.drops["delayed"] == 0
