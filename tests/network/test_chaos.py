"""Everything at once, drawn by lot: losses, cuts, restarts, moves, replays. Then the network behaves."""

from __future__ import annotations

import os
from functools import partial
from random import Random

import pytest

from tests.network.attackers import Recorder
from tests.network.network import Drone, Network, share_a_session
from uavlinkd.core.settings import Link, Timers
from uavlinkd.mitm.radio import Bursts, RadioSettings

SEEDS = int(os.environ.get("UAVLINKD_CHAOS_SEEDS", "24"))
"""How many drawn histories are played."""
BACK_WITHIN_S = 3.0
CLOCKS = (0.0, 1.0, 2.0**32)


def _draw_radio(lot: Random) -> RadioSettings:
    return RadioSettings(
        loss=lot.choice((0.0, 0.1, 0.3, 0.6)),
        bursts=lot.choice((None, None, Bursts(to_bad=0.02, to_good=0.1))),
        delay_s=lot.choice((0.0, 0.02, 0.1, 0.3)),
        jitter_s=lot.choice((0.0, 0.05)),
        duplication=lot.choice((0.0, 0.2)),
        reordering=lot.choice((0.0, 0.1)),
        bits_per_s=lot.choice((None, None, 200_000.0)),
    )


def _disturb(network: Network, drones: list[Drone], anchor: Drone, recorder: Recorder, lot: Random) -> None:
    """One misfortune. Only the anchor's address is stable, and it alone is in every configuration."""
    drone, other = lot.sample(drones, 2)
    match lot.randrange(7):
        case 0:
            network.set_radio(_draw_radio(lot))
        case 1:
            network.cut(drone, other)
        case 2:
            network.cuts.clear()
        case 3:
            drone.start(lot.choice(CLOCKS))
        case 4 if drone is not anchor:
            drone.move((f"172.16.{lot.randrange(250)}.1", lot.randrange(1024, 65536)))
        case 5:
            network.cuts.add((drone.name, other.name))
        case _:
            for datagram, source, destination in lot.choices(recorder.recorded[-5000:], k=50):
                network.inject(datagram, lot.choice((source, destination)), destination)


@pytest.mark.parametrize("batch", range(8))
def test_links_are_back_soon_after_any_history(batch: int) -> None:
    """Half a minute of misfortunes drawn by lot; three seconds after the last, every link with the anchor works."""
    for seed in range(batch, SEEDS, 8):
        with Network(f"chaos {seed}", RadioSettings(delay_s=0.05)) as network:
            lot = Random(f"chaos lot {seed}")
            drones = [network.add(f"d{number}", clock=lot.choice(CLOCKS)) for number in range(lot.randint(2, 4))]
            anchor = drones[0]
            timers = Timers(rekey_after_s=lot.choice((2.0, 10.0, 120.0)), reject_after_s=180.0)
            for drone in drones[1:]:
                drone.knows(anchor, anchor.addresses, Link(timers=timers))
                # A configured address that the drone has left is of no use, and must do no harm.
                anchor.knows(drone, lot.choice(((), drone.addresses)), Link(timers=timers))
            for drone in drones:
                drone.start()
            for drone in drones[1:]:
                network.talk(anchor, drone, interval_s=lot.choice((0.02, 0.1, 0.2)))
            recorder = Recorder(network)
            for _ in range(15):
                network.at(lot.uniform(2, 30), partial(_disturb, network, drones, anchor, recorder, lot))
            network.run(30)
            network.cuts.clear()
            network.set_radio(RadioSettings(delay_s=0.05))
            network.run(BACK_WITHIN_S)
            back = network.now
            network.run(2)
            for flow in network.flows.values():
                lost = flow.lost(back, network.now - 0.1)
                assert not lost, f"{flow.sender} to {flow.receiver}: {len(lost)} lost since {back}"
            for drone in drones[1:]:  # at once, but for a change of keys that is on its way
                network.run_until(partial(share_a_session, anchor, drone), within_s=0.1)
