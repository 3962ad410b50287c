"""One run: messages offered to a bare line or to two daemons' links, and what the modems carried of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.modem.bare import SIGNATURE_BYTES, BareLine, CarefulCodec
from tests.modem.line_network import LineNetwork
from tests.modem.offered import STATION, VEHICLE, Arrivals, Offered, offered
from uavlinkd.core.settings import Link
from uavlinkd.lab.mitm.modem import Fate, ModemEnd, ModemLink, ModemSettings
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import SplitCounters, split_payload

DRAIN_S: Final = 10.0
"""Time for what waits, after the last message."""
LINK_LIMIT_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class Result:
    """What the modems carried. The telemetry is that of the vehicle, without heartbeats."""

    linked_after_s: float
    """Time until both ends had a session; 0 on the bare line."""
    offered_s: float
    delivered_s: float
    critical_vehicle: float
    """Share of the vehicle's heartbeats that arrived."""
    critical_station: float
    """Share of the station's heartbeats and commands that arrived."""
    bytes_per_frame: float
    """What the vehicle wrote to its line for each of its frames that arrived: handshakes and probes included."""
    frame_share: float
    """Bytes of the vehicle's frames that arrived, without signatures, as a share of all that it wrote."""
    oldest_s: float
    median_s: float
    """Ages of delivered frames."""
    lost_in_queue: int
    """Bytes that the modems' queues lost."""
    foreign: int
    """Frames that were delivered and not sent, or delivered twice."""


def on_bare_line(
    modem: ModemSettings, seconds: float, factor: float, codec: type[Any] = CarefulCodec, seed: int = 1
) -> Result:
    line = BareLine(modem, seed, codec)
    messages = offered(seconds, factor)
    for what in messages:
        line.run(what.at)
        line.send(what)
    line.run(seconds + DRAIN_S)
    return _result(line.arrivals, line.link, messages, seconds, SIGNATURE_BYTES, 0.0)


def through_daemons(
    modem: ModemSettings,
    seconds: float,
    factor: float,
    egress: EgressSettings | None = None,
    link: Link | None = None,
    seed: int = 1,
) -> Result:
    """Unsigned frames through two links. The link comes up first, and its handshake is counted."""
    network = LineNetwork(modem, link or Link(), egress or EgressSettings(), seed)
    while not network.is_linked() and network.now < LINK_LIMIT_S:
        network.run(network.now + 0.05)
    began = network.now
    arrivals = Arrivals()
    codec = mavlink.MAVLink(None)
    messages = offered(seconds, factor)
    for what in messages:
        network.run(began + what.at)
        codec.srcSystem, codec.srcComponent = what.system, 1
        raw = bytes(what.message.pack(codec))
        (frame,) = split_payload(raw, SplitCounters())
        arrivals.send(raw, what, network.now)
        (network.alpha if what.system == VEHICLE else network.bravo).send(frame)
    network.run(began + seconds + DRAIN_S)
    for end in (network.alpha, network.bravo):
        for frame, at in zip(end.delivered, end.delivered_at, strict=True):
            arrivals.deliver(frame.raw, at)
    return _result(arrivals, network.modems, messages, seconds, 0, began)


def _result(
    arrivals: Arrivals,
    link: ModemLink,
    messages: Sequence[Offered],
    seconds: float,
    signature_bytes: int,
    linked_after_s: float,
) -> Result:
    def count(system: int, chosen: Callable[[Offered], bool]) -> int:
        return sum(one.system == system and chosen(one) for one in messages)

    ages = sorted(arrivals.ages_s.values())
    frames = arrivals.delivered(VEHICLE)
    telemetry = [frame for frame in frames if not arrivals.sent[frame][1].is_critical]
    written = link.bytes[ModemEnd.LEFT][Fate.WRITTEN]
    return Result(
        linked_after_s=linked_after_s,
        offered_s=count(VEHICLE, lambda one: not one.is_critical) / seconds,
        delivered_s=len(telemetry) / seconds,
        critical_vehicle=arrivals.share(VEHICLE, is_critical=True),
        critical_station=arrivals.share(STATION, is_critical=True),
        bytes_per_frame=written / max(1, len(frames)),
        frame_share=sum(len(frame) - signature_bytes for frame in frames) / written,
        oldest_s=ages[-1] if ages else 0.0,
        median_s=ages[len(ages) // 2] if ages else 0.0,
        lost_in_queue=sum(link.bytes[end][Fate.QUEUE_FULL] for end in ModemEnd),
        foreign=arrivals.foreign,
    )
