"""One of two paths dies: what is lost, and for how long frames do not arrive. In virtual time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median

from tests.network.air import Hop
from tests.network.drone import Drone
from tests.network.flow import Flow
from tests.network.network import Network
from tests.network.vehicle import hop, linked_vehicle
from uavlinkd.core.outputs import PathStateChanged
from uavlinkd.core.settings import Class
from uavlinkd.lab.mitm.radio import RadioSettings

STREAM_PER_S = 51.0
"""Frames of telemetry a second from the vehicle, as PX4's fastest usual mode."""
_SETTLE_S = 6.0
_WATCH_S = 10.0
"""The path is dead for this long."""
_RETURN_S = 10.0


@dataclass(frozen=True)
class Radios:
    """Both radios of the vehicle."""

    name: str
    round_trip_s: float
    """The mean."""
    jitter_s: float
    """The one-way delay varies by this in all."""

    @property
    def settings(self) -> RadioSettings:
        """One direction of one of them."""
        return RadioSettings(delay_s=(self.round_trip_s - self.jitter_s) / 2, jitter_s=self.jitter_s)


RADIOS = (
    Radios("100 ms, jitter 5 ms", 0.1, 0.005),
    Radios("20 ms, jitter 5 ms", 0.02, 0.005),
    Radios("300 ms, jitter 5 ms", 0.3, 0.005),
    Radios("100 ms, jitter 20 ms", 0.1, 0.02),
)


@dataclass(frozen=True)
class Failover:
    """The result of one failure. Durations in seconds."""

    critical_sent: int
    critical_lost: int
    critical_gap_s: float
    """The longest time without a critical frame, of both directions."""
    stream_gap_s: float
    stream_lost: int
    detected_s: float
    """Until the vehicle takes the dead path for down."""
    returned_s: float
    """Until the vehicle takes it for usable, after it works again."""
    return_gap_s: float
    """The longest time without a frame of the stream after that."""


def fail_over(radios: Radios, seed: int, *, survivor_alone: bool = False) -> Failover:
    """Let the vehicle's best path die at a random moment, and return later.

    ``survivor_alone``: the same traffic over one path, which does not die.
    """
    with Network(f"failover {radios.name} {seed}") as network:
        settings = [radios.settings] * (1 if survivor_alone else 2)
        vehicle, station = linked_vehicle(network, settings)
        stream, critical = _talk(network, vehicle, station)
        network.run(_SETTLE_S + network.rng.random())
        dead = None if survivor_alone else _best(vehicle, station)
        begin = network.now
        if dead is not None:
            network.cut_path(dead)
        network.run(_WATCH_S)
        healed = network.now
        if dead is not None:
            network.heal_path(dead)
        network.run(_RETURN_S)
        until, flight_s = network.now - 1, radios.round_trip_s + radios.jitter_s
        return Failover(
            critical_sent=sum(len(flow.sent_at) for flow in critical),
            critical_lost=sum(len(flow.lost(begin - flight_s, until)) for flow in critical),
            critical_gap_s=max(flow.longest_gap(begin - 2, healed) for flow in critical),
            stream_gap_s=stream.longest_gap(begin - 1, healed),
            stream_lost=len(stream.lost(begin - flight_s, until)),
            detected_s=_first_change(vehicle, dead, begin, is_usable=False),
            returned_s=_first_change(vehicle, dead, healed, is_usable=True),
            return_gap_s=stream.longest_gap(healed - 1, until),
        )


def _talk(network: Network, vehicle: Drone, station: Drone) -> tuple[Flow, tuple[Flow, Flow]]:
    """Telemetry, heartbeats of both, commands and their acknowledgements, each at a random phase."""
    stream = network.traffic(vehicle, station, 1 / STREAM_PER_S)
    for sender, receiver in ((vehicle, station), (station, vehicle)):
        for interval_s in (1.0, 0.5):
            network.traffic(sender, receiver, interval_s, cls=Class.CRITICAL)
    return stream, (
        network.flow(vehicle, station, Class.CRITICAL),
        network.flow(station, vehicle, Class.CRITICAL),
    )


def _best(vehicle: Drone, station: Drone) -> Hop:
    best = vehicle.peer(station).path
    assert best is not None
    return hop(vehicle, station, best.socket)


def _first_change(vehicle: Drone, path: Hop | None, since: float, *, is_usable: bool) -> float:
    return next(
        (
            at - since
            for at, event in vehicle.outputs
            if path is not None
            and at >= since
            and isinstance(event, PathStateChanged)
            and event.path.socket == path.sender.socket
            and event.is_usable == is_usable
        ),
        0.0,
    )


def table(radios: Radios, tries: int) -> Iterator[str]:
    """The figures of many failures, one line for each."""
    results = [fail_over(radios, seed) for seed in range(tries)]
    alone = [fail_over(radios, seed, survivor_alone=True) for seed in range(tries)]
    yield f"{radios.name}: {tries} failures"
    lost, sent = sum(r.critical_lost for r in results), sum(r.critical_sent for r in results)
    yield f"  critical frames lost      {lost} of {sent:,}"
    yield f"  gap of critical frames    {_spread([r.critical_gap_s for r in results])}"
    yield f"    on the survivor alone   {_spread([r.critical_gap_s for r in alone])}"
    longer = [two.critical_gap_s - one.critical_gap_s for two, one in zip(results, alone, strict=True)]
    yield f"    longer by               {_spread(longer)}"
    yield f"  gap of the stream         {_spread([r.stream_gap_s for r in results])}"
    yield f"  frames of it lost         {_spread([float(r.stream_lost) for r in results], unit='')}"
    yield f"  dead path down after      {_spread([r.detected_s for r in results])}"
    yield f"  usable again after        {_spread([r.returned_s for r in results])}"
    yield f"  gap of the stream then    {_spread([r.return_gap_s for r in results])}"


def _spread(values: Sequence[float], unit: str = " s") -> str:
    return f"median {median(values):.3f}{unit}, largest {max(values):.3f}{unit}"
