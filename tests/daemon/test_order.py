"""What one system and component sends arrives in the order in which it was sent, along any paths.

pymavlink judges: it counts gaps in the sequence numbers, and rejects a signed frame whose timestamp does not grow.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import accumulate
from random import Random
from typing import Any

import pytest

from tests.daemon.two_radios import Network, Radio
from tests.samples import raws
from tests.signed_frames import Autopilot, Station
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.protocol.settings import Link, Redundancy, Timers

EVERY_S = 0.02
"""Between bursts of the autopilot."""
ENVELOPES_PER_BURST = 2
"""Or fewer. With an envelope for each class there were up to three, and copies."""


def fly(network: Network, autopilot: Autopilot, seconds: float) -> None:
    """The autopilot at bravo sends telemetry and a log for some seconds."""
    for _ in range(round(seconds / EVERY_S)):
        network.bravo.send(*autopilot.burst())
        network.run(network.now + EVERY_S)


def begin(radios: Sequence[Radio], metered: Collection[int] = (), **settings: Any) -> tuple[Network, Autopilot]:
    """Two ends with these radios, all usable, and an autopilot that has sent nothing yet. Frames have flown."""
    network = Network(radios, **settings)
    network.establish()
    set_metered(network, metered)
    fly(network, Autopilot(), 3.0)  # after a silence, frames are held until the peer shows that they are new
    network.run(network.now + 0.2)
    network.bravo.sent.clear()
    network.alpha.delivered.clear()
    return network, Autopilot()


def set_metered(network: Network, metered: Collection[int]) -> None:
    for end in (network.alpha, network.bravo):
        end.node.set_metered(metered, network.now)


NEAR, FAR, RELAYED = Radio(0.005), Radio(0.05), Radio(0.02, is_relayed=True)
BUSY = Radio(0.002, is_relayed=True, jitter_s=0.008)
"""A relay on a machine that does other work too."""
NO_DELAY = EgressSettings()


@pytest.mark.parametrize(
    ("radios", "metered", "egress"),
    [
        pytest.param([NEAR], [], NO_DELAY, id="direct"),
        pytest.param([RELAYED], [], NO_DELAY, id="relay"),
        pytest.param([NEAR, FAR], [], NO_DELAY, id="two paths"),
        pytest.param([FAR, RELAYED], [], NO_DELAY, id="direct and relay"),
        pytest.param([FAR, NEAR], [1], NO_DELAY, id="copies along a faster path"),
        pytest.param([BUSY, BUSY], [], NO_DELAY, id="two relays, now one and now the other is faster"),
        pytest.param([NEAR, FAR], [], EgressSettings(coalesce_s=0.05), id="coalescing"),
        pytest.param([NEAR, FAR], [], EgressSettings(budget_bits_s=2_000_000), id="budget"),
        pytest.param([Radio(0.005, budget_bits_s=2_000_000), FAR], [], NO_DELAY, id="budget of a network"),
    ],
)
def test_each_frame_arrives_once_and_in_the_order_of_its_sender(
    radios: list[Radio], metered: list[int], egress: EgressSettings
) -> None:
    """No gap in the numbers, and no signature is rejected."""
    network, autopilot = begin(radios, metered, egress={"bravo": egress})
    before = network.alpha.peer.traffic.out_of_order
    fly(network, autopilot, 6.0)
    network.run(network.now + 1)
    assert network.alpha.delivered == autopilot.sent
    station = Station(raws(network.alpha.delivered))
    assert (station.packet_loss(), station.rejected) == (0, 0)
    assert network.alpha.peer.traffic.out_of_order == before
    assert len(network.bravo.sent) < ENVELOPES_PER_BURST * 6.0 / EVERY_S


@pytest.mark.parametrize("before", [0, 1], ids=["to a slower path", "to a faster path"])
def test_change_of_the_path_keeps_the_order(before: int) -> None:
    """Frames along the new path wait for those that are still on the former one."""
    network, autopilot = begin([NEAR, FAR], [1 - before])
    fly(network, autopilot, 1.0)
    set_metered(network, [before])
    fly(network, autopilot, 1.0)
    network.run(network.now + 1)
    best = network.bravo.peer.path
    assert best is not None
    assert best.socket == 1 - before
    assert network.alpha.delivered == autopilot.sent


@pytest.mark.parametrize(
    ("radios", "after"),
    [
        pytest.param([Radio(0.02, loss=0.1)], Radio(0.02, loss=0.1), id="repair"),
        pytest.param([Radio(0.005, loss=0.1), Radio(0.05, loss=0.1)], NEAR, id="repair along two paths"),
        pytest.param([NEAR, FAR], Radio(0.005, loss=1.0), id="death of a path"),
        pytest.param([NEAR, FAR], Radio(0.1), id="a path that becomes slow"),
    ],
)
def test_what_overtakes_is_counted_and_little(radios: list[Radio], after: Radio) -> None:
    """On lossy paths, and where the delay of a path changes."""
    network, autopilot = begin(radios)
    fly(network, autopilot, 4.0)
    network.radios[0] = after
    fly(network, autopilot, 4.0)
    network.run(network.now + 1)
    check_overtaken(network, autopilot, most=0.01)


def check_overtaken(network: Network, autopilot: Autopilot, most: float) -> None:
    """Each frame arrived at most once, few of them after later ones, and these are counted."""
    numbers = {frame.raw: number for number, frame in enumerate(autopilot.sent)}
    arrived = [numbers[frame.raw] for frame in network.alpha.delivered]
    assert len(set(arrived)) == len(arrived)
    overtaken = sum(number < newest for number, newest in zip(arrived, accumulate(arrived, max), strict=True))
    assert overtaken <= most * len(arrived)
    assert overtaken == 0 or network.alpha.peer.traffic.out_of_order > 0


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 40))])
def test_random_histories_keep_the_order(seed: int) -> None:
    """Paths of any delay become metered or are so no longer, copies go along others, keys change. Nothing is lost but
    states that newer ones overtook."""
    lot = Random(f"order {seed}")
    link = Link(timers=Timers(rekey_after_s=lot.choice((3.0, 120.0))), redundancy=lot.choice(list(Redundancy)))
    radios = [Radio(lot.uniform(0.001, 0.09), is_relayed=lot.random() < 0.2) for _ in range(lot.choice((2, 3)))]
    network, autopilot = begin(radios, link=link, seed=seed)
    before = network.alpha.link.frames_superseded
    for _ in range(4):
        set_metered(network, [number for number in range(len(radios)) if lot.random() < 0.4])
        fly(network, autopilot, lot.uniform(0.5, 3.0))
    network.run(network.now + 1)
    superseded = network.alpha.link.frames_superseded - before
    assert len(network.alpha.delivered) + superseded == len(autopilot.sent)
    assert superseded <= 0.01 * len(autopilot.sent)
    check_overtaken(network, autopilot, most=0.02)
