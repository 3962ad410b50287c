"""Frames that wait, and a link with a budget on virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.dialect import ids_by_name, name_of
from uavlinkd.mavlink.egress.budgeted import Egress, EgressSettings, EnvelopeShape
from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_datagram

SHAPE = EnvelopeShape(payload_limit=1200, seal_bytes=23, carrier_bytes=28)


SLOW = EgressSettings(budget_bits_s=4000)


ID = ids_by_name()


def frame(message: Any, system: int = 1, component: int = 1) -> Frame:
    """The message as this daemon would read it from a local client."""
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    (made,) = split_datagram(message.pack(sender), SplitCounters())
    return made


def raws(frames: Iterable[Frame]) -> list[bytes]:
    """The bytes of frames."""
    return [raw for raw, _ in frames]


def attitude(number: int, system: int = 1) -> Frame:
    return frame(mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1), system)


def heartbeat(number: int, system: int = 1, component: int = 1) -> Frame:
    return frame(mavlink.MAVLink_heartbeat_message(2, 3, 81, number, 4, 3), system, component)


def command(number: int, system: int = 255) -> Frame:
    return frame(mavlink.MAVLink_command_long_message(1, 1, 400, 0, number, 1, 1, 1, 1, 1, 1), system)


def parameter(number: int) -> Frame:
    return frame(mavlink.MAVLink_param_value_message(b"SERVO_FUNCTION", float(number), 9, 999, number))


def battery(number: int, which: int) -> Frame:
    return frame(mavlink.MAVLink_battery_status_message(which, 1, 1, 2500, [4000] * 10, 120, number, 9, 77))


class Link:
    """One egress, and the wire behind it: each envelope is sent and accounted for at once. Time is virtual."""

    def __init__(self, options: EgressSettings, shape: EnvelopeShape = SHAPE) -> None:
        self.egress = Egress(options, 0.0, shape)
        self.shape = shape
        self.sent: list[tuple[float, bytes]] = []
        self.envelopes: list[tuple[float, list[bytes]]] = []
        self.wire: list[tuple[float, int]] = []
        self.offered: dict[bytes, float] = {}

    def put(self, *frames: Frame, now: float) -> None:
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
            self.transmit(self.shape.seal_bytes + sum(map(len, sent)), now)

    def transmit(self, datagram_bytes: int, now: float) -> None:
        self.egress.spend(datagram_bytes, now)
        self.wire.append((now, datagram_bytes + self.shape.carrier_bytes))

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
    (made,) = split_datagram(raw, SplitCounters())
    return flow_key(made)


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
