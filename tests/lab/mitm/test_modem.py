"""The emulated modems: rates, half duplex, the queue, errors, boundaries of air packets, the plug."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from random import Random

import pytest

from uavlinkd.lab.mitm.modem import Fate, ModemEnd, ModemLink, ModemSettings, Transmission

LEFT, RIGHT = ModemEnd.LEFT, ModemEnd.RIGHT
SIK = ModemSettings()


class Bench:
    """A link in virtual time, and what came out."""

    def __init__(self, settings: ModemSettings = SIK, seed: int = 1) -> None:
        self.packets: list[Transmission] = []
        self.link = ModemLink(settings, Random(seed), self.packets.append)
        self.now = 0.0
        self.arrived: dict[ModemEnd, bytearray] = {end: bytearray() for end in ModemEnd}
        self.times: dict[ModemEnd, list[float]] = {end: [] for end in ModemEnd}

    def write(self, end: ModemEnd, data: bytes) -> int:
        return self.link.write(end, data, self.now)

    def run(self, until: float) -> None:
        """Let time jump from event to event."""
        while (at := self.link.next_deadline()) <= until:
            self._collect(at)
        self._collect(until)

    def feed(self, data: dict[ModemEnd, bytes], until: float, step_s: float = 0.01) -> None:
        """Keep the kernels of these hosts full."""
        while self.now < until:
            for end, block in data.items():
                self.write(end, block)
            self.run(self.now + step_s)

    def _collect(self, at: float) -> None:
        self.now = max(self.now, at)
        for end, data in self.link.advance(self.now):
            self.arrived[end] += data
            self.times[end].append(self.now)

    def count(self, end: ModemEnd, fate: Fate) -> int:
        return self.link.bytes[end][fate]


def numbered(size: int) -> bytes:
    """Bytes of which each piece of 4 is unique."""
    return b"".join(number.to_bytes(4, "big") for number in range((size + 3) // 4))[:size]


@pytest.mark.parametrize("air_bits_s", [4_000.0, 24_000.0, 40_000.0])
def test_air_rate_is_held(air_bits_s: float) -> None:
    """Within 1 %, while one host writes all the time."""
    bench = Bench(replace(SIK, air_bits_s=air_bits_s, has_flow_control=True))
    bench.feed({LEFT: bytes(4096)}, until=60)

    carried_bits = 8 * sum(len(packet.data) for packet in bench.packets)
    assert carried_bits / bench.packets[-1].end_at == pytest.approx(air_bits_s, rel=0.01)
    assert len(bench.arrived[RIGHT]) == pytest.approx(air_bits_s / 8 * 60, rel=0.01)


def test_air_is_half_duplex() -> None:
    """Packets never overlap, a change of the sender takes the turn-around time, and both ends get their turns."""
    bench = Bench(replace(SIK, has_flow_control=True))
    bench.feed({LEFT: bytes(4096), RIGHT: bytes(4096)}, until=60)

    assert len(bench.packets) > 500
    for earlier, later in pairwise(bench.packets):
        gap_s = SIK.turn_around_s if earlier.sender is not later.sender else 0.0
        assert later.begin_at >= earlier.end_at + gap_s - 1e-9
    shares = [len(bench.arrived[end]) for end in ModemEnd]
    assert shares[0] == pytest.approx(shares[1], rel=0.02)
    turns = 1 + sum(earlier.sender is not later.sender for earlier, later in pairwise(bench.packets))
    busy_s = 60 - turns * SIK.turn_around_s
    assert 8 * sum(len(packet.data) for packet in bench.packets) == pytest.approx(24_000 * busy_s, rel=0.01)


def test_queue_never_exceeds_its_size() -> None:
    """Under a load of more than the air carries, with and without RTS/CTS."""
    for has_flow_control in (False, True):
        bench = Bench(replace(SIK, queue_bytes=1_500, has_flow_control=has_flow_control))
        sizes = []
        for _ in range(500):
            bench.write(LEFT, bytes(300))
            bench.run(bench.now + 0.01)
            sizes.append(bench.link.queued(LEFT, bench.now))
        assert max(sizes) == 1_500
        assert bool(bench.count(LEFT, Fate.QUEUE_FULL)) is not has_flow_control


def test_error_rates() -> None:
    """Altered and lost bytes, and lost packets, in the configured shares."""
    settings = replace(
        SIK, air_bits_s=1e6, line_baud=1e6, byte_error_rate=0.01, byte_loss_rate=0.02, packet_loss=0.05
    )
    bench = Bench(settings)
    for _ in range(200):
        bench.write(LEFT, bytes(2_000))
        bench.run(bench.now + 0.1)

    on_air = bench.count(LEFT, Fate.ON_AIR)
    assert on_air == 400_000
    on_line = on_air - bench.count(LEFT, Fate.PACKET_LOST)
    assert bench.count(LEFT, Fate.PACKET_LOST) / on_air == pytest.approx(0.05, abs=0.012)
    assert bench.count(RIGHT, Fate.LOST_ON_LINE) / on_line == pytest.approx(0.02, rel=0.1)
    altered = len(bench.arrived[RIGHT]) - bench.arrived[RIGHT].count(0)
    assert altered == bench.count(RIGHT, Fate.ALTERED)
    assert altered / len(bench.arrived[RIGHT]) == pytest.approx(0.01, rel=0.1)


def test_packet_is_lost_or_arrives_whole() -> None:
    """At most ``packet_bytes`` together, across the boundaries of what the host wrote."""
    bench = Bench(replace(SIK, packet_loss=0.3, queue_bytes=4_096))
    for _ in range(40):
        bench.write(LEFT, numbered(100))
    bench.run(30)

    assert max(len(packet.data) for packet in bench.packets) == SIK.packet_bytes
    lost = bench.count(LEFT, Fate.PACKET_LOST)
    assert 0 < lost < 4_000
    rest = bytes(bench.arrived[RIGHT])
    for packet in bench.packets:
        rest = rest.removeprefix(packet.data)
    assert rest == b""
    assert len(bench.arrived[RIGHT]) == 4_000 - lost


@pytest.mark.parametrize("end", list(ModemEnd))
def test_pulled_modem_loses_what_it_holds(end: ModemEnd) -> None:
    """Bytes in the kernel, in the queue, on air and on the line are lost. What is written later arrives."""
    bench = Bench()
    data = numbered(2_000)
    bench.write(LEFT, data)
    bench.run(0.3)
    bench.link.pull(end, bench.now)
    assert not bench.link.is_plugged(end)
    bench.run(2)
    before = len(bench.arrived[RIGHT])
    assert bench.write(end, b"into the void") == 13
    bench.run(4)
    assert len(bench.arrived[RIGHT]) == before < 2_000
    bench.link.plug(end, bench.now)
    bench.write(LEFT, b"again")
    bench.write(RIGHT, b"as well")
    bench.run(6)

    assert bytes(bench.arrived[RIGHT][before:]) == b"again"
    assert bytes(bench.arrived[LEFT]) == b"as well"
    assert sum(bench.count(one, Fate.UNPLUGGED) for one in ModemEnd) == 2_000 - before + 13


def test_held_frames_come_after_the_hold() -> None:
    """In order, at the rate of the line. What was on the line before the hold is not held."""
    bench = Bench()
    bench.link.hold(RIGHT, 10.0, bench.now)
    bench.write(LEFT, numbered(1_000))
    bench.run(9.99)
    assert not bench.arrived[RIGHT]
    bench.run(11)

    assert bytes(bench.arrived[RIGHT]) == numbered(1_000)
    assert bench.times[RIGHT][0] > 10
    assert bench.times[RIGHT][-1] == pytest.approx(10 + 10_000 / 57_600)
