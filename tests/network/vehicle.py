"""A vehicle with several radios and its ground station, in the simulated network."""

from __future__ import annotations

from collections.abc import Sequence

from tests.network.air import Hop
from tests.network.drone import Drone, share_a_session
from tests.network.network import Network
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import Link


def add_vehicle(
    network: Network, radios: Sequence[RadioSettings], link: Link | None = None, *, is_known: bool = True
) -> tuple[Drone, Drone]:
    """A vehicle with one network for each radio, and a station with one address. They are not started.

    ``is_known``: the station has the vehicle's addresses in its configuration.
    """
    vehicle = network.add("v", *((f"10.{number}.0.1", 5790) for number in range(len(radios))))
    station = network.add("s", ("192.0.2.1", 5790), clock=1e6)
    vehicle.knows(station, [Path(number, station.addresses[0]) for number in range(len(radios))], link)
    station.knows(vehicle, vehicle.addresses if is_known else (), link)
    for number, radio in enumerate(radios):
        network.set_path(hop(vehicle, station, number), radio)
    return vehicle, station


def linked_vehicle(
    network: Network, radios: Sequence[RadioSettings], link: Link | None = None, *, is_known: bool = True
) -> tuple[Drone, Drone]:
    """The same with a session, and with every path usable at both ends."""
    vehicle, station = add_vehicle(network, radios, link, is_known=is_known)
    vehicle.start()
    station.start()
    network.run_until(lambda: share_a_session(vehicle, station), within_s=5)
    network.run_until(lambda: all(map(_all_work, (vehicle, station), (station, vehicle))), within_s=10)
    return vehicle, station


def hop(vehicle: Drone, station: Drone, number: int) -> Hop:
    return vehicle.hop(number, station, 0)


def _all_work(drone: Drone, other: Drone) -> bool:
    states = drone.peer(other).paths.states
    return len(states) == max(len(drone.addresses), len(other.addresses)) and all(state.works for state in states)
