"""A link with a budget on virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from pymavlink.dialects.v20 import all as mavlink

from tests.samples import attitude, battery, command, frame, heartbeat, parameter, raws, read
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.egress.bucket import Bucket
from uavlinkd.mavlink.egress.peer_egress import EgressSettings, EnvelopeShape, PeerEgress
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame
from uavlinkd.protocol.settings import Class

SHAPE = EnvelopeShape(payload_limit=1200, seal_bytes=23, carrier_bytes=28)
SLOW = EgressSettings(budget_bits_s=4000)


class Link:
    """One egress, and the wire behind it: each envelope is sent and accounted for at once."""

    def __init__(self, settings: EgressSettings, shape: EnvelopeShape = SHAPE, *networks: Bucket | None) -> None:
        """``networks``: the best path's first."""
        self.egress = PeerEgress(settings, 0.0)
        self.egress.set_shape(shape)
        self.shape = shape
        self.networks = networks
        if networks:
            self.egress.set_networks(networks)
        self.sent: list[tuple[float, bytes]] = []
        self.envelopes: list[tuple[float, list[bytes]]] = []
        self.wire: list[tuple[float, int]] = []
        self.offered: dict[bytes, float] = {}

    def put(self, *frames: Frame, now: float) -> None:
        """Offer frames, and send what is due."""
        for raw in raws(frames):
            assert raw not in self.offered, "frames of a test differ in their bytes"
            self.offered[raw] = now
        self.egress.put(frames, now)
        self.flush(now)

    def flush(self, now: float) -> None:
        while batch := self.egress.take(now):
            sent = raws(batch)
            self.envelopes.append((now, sent))
            self.sent += [(now, raw) for raw in sent]
            is_critical = all(frame.header.kind.cls is Class.CRITICAL for frame in batch)
            along = self.networks if is_critical else self.networks[:1]
            self.transmit(self.shape.seal_bytes + sum(map(len, sent)), now, along)

    def transmit(self, datagram_bytes: int, now: float, along: Sequence[Bucket | None] = ()) -> None:
        self.egress.spend(datagram_bytes, now)
        self.wire.append((now, datagram_bytes + self.shape.carrier_bytes))
        for network in along:
            if network is not None:
                network.spend(datagram_bytes + self.shape.carrier_bytes, now)

    def fill(self, now: float) -> None:
        """Empty the bucket, so that what comes has to wait."""
        self.transmit(331 - 28, now)

    def run(self, until: float) -> None:
        """Let time pass: the egress is called at its deadlines and never else."""
        for _ in range(1_000_000):
            deadline = self.egress.next_deadline()
            if deadline > until:
                return
            self.flush(deadline)
        raise AssertionError("deadlines without end")

    def names(self) -> list[str]:
        return [name_of(id_of(raw)) for _, raw in self.sent]


def id_of(raw: bytes) -> int:
    return int.from_bytes(raw[7:10], "little")


def flow_of(raw: bytes) -> FlowKey:
    return flow_key(read(raw))


def play(link: Link, offers: Iterable[tuple[float, Frame | Callable[[], None]]], until: float) -> None:
    """Offer frames at their times; a function stands for something else that happens then."""
    for now, what in sorted(offers, key=lambda offer: offer[0]):
        link.run(now)
        if isinstance(what, Frame):
            link.put(what, now=now)
        else:
            what()
    link.run(until)


def every(period: float, make: Callable[[int], Frame], until: float, start: float = 0.0) -> list[tuple[float, Frame]]:
    return [(start + n * period, make(n)) for n in range(int((until - start) / period))]


MAKERS: Sequence[Callable[[int], Frame]] = (
    attitude,
    heartbeat,
    command,
    parameter,
    lambda n: attitude(n, 2),
    lambda n: battery(n, n % 3),
    lambda n: frame(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [1 + n % 255] * 251), 1 + n // 255),
)
