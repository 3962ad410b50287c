"""Bytes that a metered network carries in a day while it stands by, and while the peer is off. In virtual time."""

from __future__ import annotations

from collections.abc import Iterator

from tests.network.flights import HEADERS_BYTES
from tests.network.network import Network
from tests.network.vehicle import add_vehicle, linked_vehicle
from uavlinkd.core.settings import Class
from uavlinkd.lab.mitm.radio import RadioSettings

MESH, LTE = 0, 1
DAY_S = 86_400.0
_RADIOS = RadioSettings(delay_s=0.02), RadioSettings(delay_s=0.05)
_MEASURED_S = 900.0
"""A standby is measured for so long."""


def standby_bytes_a_day(*, heartbeats: bool, metered: bool = True) -> float:
    """Bytes on LTE in both directions with headers of IPv4 and UDP, while the mesh carries 51 frames a second.

    ``heartbeats``: each end sends one a second, which LTE carries too.
    """
    with Network(f"standby {heartbeats} {metered}") as network:
        vehicle, station = linked_vehicle(network, _RADIOS)
        if metered:
            vehicle.set_metered([LTE])
        network.traffic(vehicle, station, 1 / 51)
        for sender, receiver in ((vehicle, station), (station, vehicle)) if heartbeats else ():
            network.traffic(sender, receiver, 1.0, cls=Class.CRITICAL)
        network.run(20)
        path = vehicle.addresses[LTE], station.addresses[0]
        before = network.air.sent_between(*path)
        network.run(_MEASURED_S)
        datagrams, size = (
            after - earlier for after, earlier in zip(network.air.sent_between(*path), before, strict=True)
        )
        return (size + HEADERS_BYTES * datagrams) * DAY_S / _MEASURED_S


def absent_peer_bytes(seconds: float = DAY_S, addresses: int = 1) -> float:
    """Bytes that the vehicle sends on LTE in a day to a station that is off, with headers. LTE is all that it has."""
    with Network(f"absent {addresses}") as network:
        vehicle, _ = add_vehicle(network, _RADIOS[LTE:] * addresses)
        vehicle.set_metered(range(addresses))
        vehicle.start()
        network.run(seconds)
        return vehicle.bytes_sent.total() + HEADERS_BYTES * vehicle.datagrams_sent.total()


def table() -> Iterator[str]:
    """The figures, one line for each."""
    yield "bytes a day on a metered path, with headers of IPv4 and UDP"
    yield f"  standby, no critical frames                      {standby_bytes_a_day(heartbeats=False):>14,.0f}"
    yield f"  standby, heartbeats of both ends                 {standby_bytes_a_day(heartbeats=True):>14,.0f}"
    unmetered = standby_bytes_a_day(heartbeats=True, metered=False)
    yield f"  the same path, not metered                       {unmetered:>14,.0f}"
    yield f"  peer off, one path                               {absent_peer_bytes():>14,.0f}"
    yield f"  peer off, four paths                             {absent_peer_bytes(addresses=4):>14,.0f}"
