"""Random histories of members by certificate: partitions, restarts, restored disks, revocations, a captured one."""

from __future__ import annotations

import os
from itertools import combinations
from random import Random

import pytest

from tests.authority.signing import bulletin
from tests.network.certified import FIRST_BULLETIN, CertifiedDrone, CertifiedNetwork, Liar
from tests.network.network import share_a_session
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.drops import DropReason

SEEDS = int(os.environ.get("UAVLINKD_CHAOS_SEEDS", "3"))
USABLE = RadioSettings(delay_s=0.05)
HEALED_S = 6.0
"""Until all links that members call are up, and all members have the newest bulletin."""


class CertifiedHistory:
    """A ground station, vehicles that have it as a contact, some of them each other too, and a captured one."""

    def __init__(self, network: CertifiedNetwork, seed: int) -> None:
        self.network = network
        self.lot = lot = Random(f"certified {seed}")
        self.number = 1
        self.revoked: set[int] = set()
        count = lot.randint(3, 5)
        self.ground = network.add_drone(CertifiedDrone(network, "g", 1, 0.0))
        self.liar = network.add_drone(Liar(network, "liar", 2, lot.choice((0.0, 1e6))))
        self.vehicles = [
            network.add_drone(CertifiedDrone(network, f"v{serial}", serial, lot.choice((0.0, 1e9))))
            for serial in range(3, 3 + count)
        ]
        self.honest = [self.ground, *self.vehicles]
        for place, vehicle in enumerate((self.liar, *self.vehicles)):
            others: list[CertifiedDrone] = [self.liar, *self.vehicles][:place]
            vehicle.contacts = [self.ground, *lot.sample(others, min(len(others), lot.randint(0, 2)))]

    def begin(self) -> None:
        for drone in (*self.honest, self.liar):
            drone.start()
        for one, other in combinations((*self.honest, self.liar), 2):
            self.network.talk(one, other, 0.2)

    def play(self, chapters: int) -> None:
        for _ in range(chapters):
            for _ in range(self.lot.randint(3, 8)):
                self._misfortune()
                self.network.run(self.lot.uniform(0.0, 4.0))
            self._heal()
            self.network.run_until(self.is_well, within_s=HEALED_S)

    def _misfortune(self) -> None:
        lot, network, drone = self.lot, self.network, self.lot.choice(self.honest)
        match lot.randrange(6):
            case 0:
                network.cut(*lot.sample([*self.honest, self.liar], 2))
            case 1:
                network.set_radio(RadioSettings(loss=lot.uniform(0, 0.5), delay_s=lot.uniform(0, 0.2)))
            case 2 if drone.node is not None:
                drone.stop()
            case 3:  # an older disk, perhaps the first one
                drone.stop()
                drone.disk = lot.choice((drone.disk, FIRST_BULLETIN))
                drone.start()
            case _:
                self._publish(drone)

    def _publish(self, drone: CertifiedDrone) -> None:
        candidates = [one.serial for one in (self.liar, *self.vehicles) if one.serial not in self.revoked]
        if self.lot.random() < 0.5 and len(candidates) > 2:
            self.revoked.add(self.lot.choice(candidates))
        if drone.serial in self.revoked:
            drone = self.ground  # a revoked one could give it to others no more
        self.number += 1
        drone.publish(bulletin(self.number, *sorted(self.revoked)))

    def _heal(self) -> None:
        self.network.heal()
        self.network.set_radio(USABLE)
        for drone in (*self.honest, self.liar):
            if drone.node is None:
                drone.start()

    def is_well(self) -> bool:
        """Among the members that were not revoked, each with its contacts."""
        members = [drone for drone in self.honest if drone.serial not in self.revoked]
        newest = max(drone.trust.bulletin for drone in members)
        links = [(one, other) for one in members for other in one.contacts if other in members]
        return all(drone.trust.bulletin == newest for drone in members) and all(
            are_linked(*link) and share_a_session(*link) for link in links
        )


def are_linked(one: CertifiedDrone, other: CertifiedDrone) -> bool:
    """Whether each has the other as a peer that is up."""
    nodes = (one.node, other.name), (other.node, one.name)
    return all(node is not None and name in node.peers and node.peers[name].is_up for node, name in nodes)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, SEEDS))])
def test_bulletins_reach_all_and_links_return_after_any_history(seed: int) -> None:
    """No frame of a revoked member is delivered where its bulletin is known, during the history and after it."""
    with CertifiedNetwork(f"certified {seed}", USABLE) as network:
        history = CertifiedHistory(network, seed)
        history.begin()
        history.play(chapters=3)
        assert sum(drone.drops[DropReason.BAD_CONTROL] for drone in history.honest) > 0, "the captured one lies"
        assert any(flow.delivered for flow in network.flows.values())
