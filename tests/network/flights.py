"""What redundancy costs: recorded flights over one path and over two, in virtual time.

Both directions, copies and probes included. Frames that were logged within :data:`BATCH_S` arrive together, as from
an autopilot's serial port or in a datagram of a client. Manual control is left out: it is critical.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from tests.network.drone import Drone
from tests.network.network import Network
from tests.network.vehicle import linked_vehicle
from uavlinkd.core.settings import Class, Link, Redundancy
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.lab.sim.tlog import TlogRecord, read_tlog
from uavlinkd.mavlink.answers import REQUESTS, ParameterAnswers
from uavlinkd.mavlink.dialect import GROUPS, ids_by_name
from uavlinkd.mavlink.egress.by_class import split_by_class
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload

BATCH_S = 0.001
STATION_SYSTEM = 255
HEADERS_BYTES = 28
"""Of IPv4 and UDP."""
MODES: tuple[tuple[str, int, Redundancy], ...] = (
    ("one path", 1, Redundancy.CRITICAL),
    ("none", 2, Redundancy.NONE),
    ("critical", 2, Redundancy.CRITICAL),
    ("all", 2, Redundancy.ALL),
)
"""Name, number of paths, redundancy."""
_MANUAL = frozenset(ids_by_name()[name] for name in GROUPS["manual"])
_RADIO = RadioSettings(delay_s=0.05)


@dataclass(frozen=True)
class Cost:
    """What one flight took, both ends together."""

    datagrams: int
    datagram_bytes: int
    delivered_frames: int

    @property
    def with_headers(self) -> int:
        """Bytes with headers of IPv4 and UDP."""
        return self.datagram_bytes + self.datagrams * HEADERS_BYTES


@dataclass(frozen=True)
class Batch:
    """Frames of one sender that arrive together."""

    at_s: float
    """Since the flight began."""
    from_station: bool
    frames: tuple[Frame, ...]


class FlightNetwork(Network):
    """Carries MAVLink frames, and counts them when they are delivered."""

    delivered_frames = 0

    def deliver(self, drone: Drone, sender: Drone, payload: bytes, order: int) -> None:
        """Count the frames; the tests of the core and of histories compare them."""
        counters = SplitCounters()
        self.delivered_frames += len(split_payload(payload, counters))
        assert not counters.garbage_bytes


def read_flight(path: Path, seconds: float) -> list[Batch]:
    """The first seconds of a flight, without manual control."""
    records = read_tlog(path).records
    began_us = records[0].time_us
    known = [record for record in records if record.time_us - began_us <= seconds * 1e6]

    def key(record: TlogRecord) -> tuple[int, bool]:
        return int((record.time_us - began_us) / 1e6 / BATCH_S), record.system_id == STATION_SYSTEM

    batches: list[Batch] = []
    for (step, from_station), together in groupby(known, key):
        frames = split_payload(b"".join(record.frame for record in together), SplitCounters())
        wanted = tuple(frame for frame in frames if frame.header.msgid not in _MANUAL)
        if wanted:
            batches.append(Batch(step * BATCH_S, from_station, wanted))
    return sorted(batches, key=lambda batch: batch.at_s)


def fly(batches: list[Batch], paths: int, redundancy: Redundancy) -> Cost:
    """Carry a flight over one path or several."""
    with FlightNetwork("flight") as network:
        vehicle, station = linked_vehicle(network, [_RADIO] * paths, Link(redundancy=redundancy))
        answers = {vehicle: ParameterAnswers(), station: ParameterAnswers()}
        network.run(1)
        begin, before = network.now, _sent(vehicle, station)

        def send(batch: Batch) -> None:
            sender, receiver = (station, vehicle) if batch.from_station else (vehicle, station)
            for frame in batch.frames:
                if frame.header.msgid in REQUESTS:
                    answers[receiver].note(frame, network.now)
            assert sender.node is not None
            peer = sender.peer(receiver)
            parts = split_by_class(batch.frames, answers[sender].class_of, network.now)
            if not peer.paths.is_multiple:
                parts = [(Class.STREAM, batch.frames)]
            for cls, part in parts:
                raws = [frame.raw for frame in part]
                network.perform(sender, sender.node.send(peer, raws, sender.local_now, cls))

        def send_from(number: int) -> None:
            send(batches[number])
            if number + 1 < len(batches):
                network.at(begin + batches[number + 1].at_s, lambda: send_from(number + 1))

        network.at(begin + batches[0].at_s, lambda: send_from(0))
        network.run(batches[-1].at_s + 0.5)
        after = _sent(vehicle, station)
        return Cost(after[0] - before[0], after[1] - before[1], network.delivered_frames)


def table(path: Path, seconds: float) -> Iterator[str]:
    """The cost of one flight with each redundancy, one line for each."""
    batches = read_flight(path, seconds)
    costs = {name: fly(batches, paths, redundancy) for name, paths, redundancy in MODES}
    alone = costs["one path"]
    frames = sum(len(batch.frames) for batch in batches)
    yield f"{path.name}: {frames:,} frames in {batches[-1].at_s:.0f} s, {len(batches):,} batches"
    for name, cost in costs.items():
        more = cost.datagram_bytes / alone.datagram_bytes - 1
        with_headers = cost.with_headers / alone.with_headers - 1
        yield (
            f"  {name:<10} {cost.datagrams:>8,} datagrams {cost.datagram_bytes:>11,} bytes"
            f"  {more:+7.1%}, with IP headers {with_headers:+7.1%}; {cost.delivered_frames:,} frames delivered"
        )


def _sent(*drones: Drone) -> tuple[int, int]:
    return sum(drone.datagrams_sent.total() for drone in drones), sum(drone.bytes_sent.total() for drone in drones)
