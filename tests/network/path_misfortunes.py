"""What befalls one path of two peers in a random history, while their other paths work or do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from tests.network.air import Address, Hop
from tests.network.drone import Drone
from tests.network.fleet import Fleet
from tests.network.serial_line import SIK
from uavlinkd.lab.mitm.modem import ModemSettings
from uavlinkd.lab.mitm.radio import Bursts, RadioSettings

_SHARE_OF_MODEMS = 0.5
"""Of what befalls a serial line. The rest may befall any path."""


class Befalling:
    """What the kinds of misfortunes share."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._network = fleet.network
        self._lot = fleet.lot
        self._until = 0.0
        """What ends by itself ends by then, or not at all."""

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do it after some seconds, unless the disruption is over by then."""
        if self._network.now + seconds < self._until:
            self._network.at(self._network.now + seconds, action)


class PathMisfortunes(Befalling):
    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        network, lot = self._network, self._lot
        self._kinds: tuple[tuple[str, Callable[[Hop], None]], ...] = (
            ("path dies", self._die),
            ("path dies one way", self._die_one_way),
            ("path heals", self._heal),
            ("path stalls", lambda hop: network.stall_path(hop, lot.choice((0.3, 1.0, 3.0, 10.0)))),
            ("path degrades", self._degrade),
            ("path has another radio", lambda hop: network.set_path(hop, random_radio(fleet))),
            ("path loses one way", self._lose_one_way),
            ("path flaps", self._flap),
            ("paths alternate", self._alternate),
            ("network gone for a while", self._lose_network),
            ("path rebinds", self._rebind),
            ("network metered", self._meter),
        )
        self._of_lines: tuple[tuple[str, Callable[[Hop], None]], ...] = (
            ("modems lose and alter", lambda hop: network.set_modems(hop.sender, random_modems(fleet))),
            ("modems are sound", lambda hop: network.set_modems(hop.sender, SIK)),
            ("noise on the line", self._make_noise),
            ("modem pulled", self._lose_network),
        )

    def befall(self, until: float) -> str:
        self._until = until
        kinds = self._kinds
        hop = self._lot.choice(self._lot.choice(self._fleet.pairs).hops)
        if hop.sender in self._network.lines and self._lot.random() < _SHARE_OF_MODEMS:
            kinds = self._of_lines
        name, befalls = self._lot.choice(kinds)
        self._network.note(f"{name}: {hop}")
        befalls(hop)
        return name

    def _die(self, hop: Hop) -> None:
        self._network.cut_path(hop)
        self._later(self._lot.choice((1.0, 5.0, 15.0)), partial(self._network.heal_path, hop))

    def _die_one_way(self, hop: Hop) -> None:
        self._network.air.cut(self._lot.choice((hop, hop.back)), self._network.now)
        self._later(self._lot.choice((1.0, 5.0, 15.0)), partial(self._network.heal_path, hop))

    def _heal(self, hop: Hop) -> None:
        self._network.heal_path(hop)
        self._network.set_path(hop, self._network.radio)

    def _degrade(self, hop: Hop) -> None:
        radio, step_s = random_radio(self._fleet), self._lot.choice((0.5, 2.0))
        for step in range(1, 9):
            self._later(step * step_s, partial(self._network.set_path, hop, replace(radio, loss=step / 10)))

    def _lose_one_way(self, hop: Hop) -> None:
        bad = replace(self._network.radio, loss=self._lot.choice((0.1, 0.3, 0.6)))
        self._network.air.set_hop(self._lot.choice((hop, hop.back)), bad, self._network.now)

    def _flap(self, hop: Hop) -> None:
        period_s = self._lot.choice((0.2, 0.7, 1.5, 3.0))
        for number in range(6):
            self._later(2 * number * period_s, partial(self._network.cut_path, hop))
            self._later((2 * number + 1) * period_s, partial(self._network.heal_path, hop))

    def _alternate(self, hop: Hop) -> None:
        """One path works while another does not, in turn."""
        others = [other for pair in self._fleet.pairs if hop in pair.hops for other in pair.hops if other != hop]
        other = self._lot.choice(others or [hop])
        period_s = self._lot.choice((1.0, 4.0, 13.0))
        self._network.heal_path(other)
        for number in range(4):
            down, up = (hop, other) if number % 2 == 0 else (other, hop)
            self._later(number * period_s, partial(self._network.cut_path, down))
            self._later(number * period_s, partial(self._network.heal_path, up))
        self._later(4 * period_s, partial(self._network.heal_path, other))

    def _lose_network(self, hop: Hop) -> None:
        endpoint = self._lot.choice(hop)
        drone = self._network.drones[endpoint.drone]
        drone.lose_network(endpoint.socket)
        self._later(self._lot.choice((1.0, 5.0, 15.0)), partial(drone.find_network, endpoint.socket))

    def _rebind(self, hop: Hop) -> None:
        wanderers = [drone for drone in self._fleet.wanderers if drone.name in {end.drone for end in hop}]
        for drone in wanderers:
            for end in hop:
                if end.drone == drone.name and end not in self._network.lines:
                    drone.move_socket(end.socket, random_address(self._fleet, drone))

    def _meter(self, hop: Hop) -> None:
        endpoint = self._lot.choice(hop)
        drone = self._network.drones[endpoint.drone]
        drone.set_metered(drone.metered_sockets ^ {endpoint.socket})

    def _make_noise(self, hop: Hop) -> None:
        """A burst of bytes, several times."""
        count, step_s = self._lot.choice((1, 60, 600)), self._lot.choice((0.1, 0.7))
        for step in range(10):
            self._later(step * step_s, partial(self._network.make_noise, hop.sender, count))


def random_radio(fleet: Fleet) -> RadioSettings:
    """Any radio, from a perfect one to one that loses most."""
    lot = fleet.lot
    return RadioSettings(
        loss=lot.choice((0.0, 0.1, 0.3, 0.6)),
        bursts=lot.choice((None, None, Bursts(to_bad=0.02, to_good=0.1))),
        delay_s=lot.choice((0.0, 0.02, 0.1, 0.3)),
        jitter_s=lot.choice((0.0, 0.05, 0.2)),
        duplication=lot.choice((0.0, 0.2)),
        reordering=lot.choice((0.0, 0.1)),
        bits_per_s=lot.choice((None, None, 200_000.0)),
    )


def random_modems(fleet: Fleet) -> ModemSettings:
    """Modems that damage some datagrams, or most."""
    lot = fleet.lot
    return replace(
        SIK,
        packet_loss=lot.choice((0.0, 0.05, 0.3)),
        byte_error_rate=lot.choice((0.0, 0.0001, 0.001, 0.01)),
        byte_loss_rate=lot.choice((0.0, 0.0, 0.001)),
        turn_around_s=lot.choice((0.01, 0.05)),
    )


def random_address(fleet: Fleet, drone: Drone) -> Address:
    """An address that no other drone has."""
    host = f"172.16.{fleet.lot.randrange(250)}.{fleet.drones.index(drone) + 1}"
    return host, fleet.lot.randrange(1024, 65536)
