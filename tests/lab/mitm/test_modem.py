"""The emulated modems: rates, half duplex, the plug."""

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

    def count(self, end: ModemEnd, fate: Fate) -> int:
        return self.link.bytes[end][fate]


def numbered(size: int) -> bytes:
    """Bytes of which each piece of 4 is unique."""
    return b"".join(number.to_bytes(4, "big") for number in range((size + 3) // 4))[:size]


@pytest.mark.parametrize("air_bits_s", [4_000.0, 24_000.0, 40_000.0])
def test_air_rate_is_held(air_bits_s: float) -> None:
    """Within 1 %, while one host writes all the time."""
    bench = Bench(replace(SIK, air_bits_s=air_bits_s))
    bench.feed({LEFT: bytes(4096)}, until=60)

    carried_bits = 8 * sum(len(packet.data) for packet in bench.packets)
    assert carried_bits / bench.packets[-1].end_at == pytest.approx(air_bits_s, rel=0.01)
    assert len(bench.arrived[RIGHT]) == pytest.approx(air_bits_s / 8 * 60, rel=0.01)


def test_air_is_half_duplex() -> None:
    """Packets never overlap, a change of the sender takes the turn-around time, and both ends get their turns."""
    bench = Bench()
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
