"""The emulated modems: rates, half duplex, the queue, errors, boundaries of air packets, the plug."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from random import Random
from typing import Any

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
        """Write now."""
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
        """Bytes with a fate."""
        return self.link.bytes[end][fate]


def numbered(size: int) -> bytes:
    """Bytes of which each piece of 4 is unique."""
    return b"".join(number.to_bytes(4, "big") for number in range((size + 3) // 4))[:size]


def test_bytes_cross_in_order() -> None:
    """Both lines and the air take their time: 100 bytes at 57,600 baud, 24 kbit/s, 57,600 baud."""
    bench = Bench(replace(SIK, gather_s=1.0, packet_bytes=100))
    bench.write(LEFT, numbered(100))
    bench.run(10)

    assert bytes(bench.arrived[RIGHT]) == numbered(100)
    assert bench.times[RIGHT][-1] == pytest.approx(1000 / 57_600 + 800 / 24_000 + 1000 / 57_600)
    assert bench.link.next_deadline() == math.inf


@pytest.mark.parametrize("air_bits_s", [4_000.0, 24_000.0, 40_000.0])
def test_air_rate_is_held(air_bits_s: float) -> None:
    """Within 1 %, while one host writes all the time."""
    bench = Bench(replace(SIK, air_bits_s=air_bits_s, has_flow_control=True))
    bench.feed({LEFT: bytes(4096)}, until=60)

    carried_bits = 8 * sum(len(packet.data) for packet in bench.packets)
    assert carried_bits / bench.packets[-1].end_at == pytest.approx(air_bits_s, rel=0.01)
    assert len(bench.arrived[RIGHT]) == pytest.approx(air_bits_s / 8 * 60, rel=0.01)


def test_line_rate_is_held() -> None:
    """Within 1 %: with a fast air, the line at 9,600 baud is the limit."""
    bench = Bench(replace(SIK, air_bits_s=250_000, line_baud=9_600))
    bench.feed({LEFT: bytes(4096)}, until=30)

    assert len(bench.arrived[RIGHT]) / 30 == pytest.approx(960, rel=0.01)
    assert not bench.count(LEFT, Fate.QUEUE_FULL)


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


def test_turn_around_delays_an_answer() -> None:
    """The other end answers at once, and the air is silent before the answer."""
    bench = Bench(replace(SIK, turn_around_s=0.25))
    bench.write(LEFT, b"question")
    bench.run(1)
    bench.write(RIGHT, b"answer")
    bench.run(3)

    first, second = bench.packets
    assert (first.sender, second.sender) == (LEFT, RIGHT)
    assert second.begin_at == pytest.approx(1 + 10 / 57_600 + 0.005 + 0.25)


def test_queue_overflows_without_notice() -> None:
    """The host writes 4,000 bytes in 0.7 s; the air carries 500 a second. What does not fit is lost and counted."""
    bench = Bench(replace(SIK, air_bits_s=4_000, queue_bytes=1_000))
    assert bench.write(LEFT, numbered(4_000)) == 4_000
    bench.run(60)

    lost = bench.count(LEFT, Fate.QUEUE_FULL)
    assert len(bench.arrived[RIGHT]) == 4_000 - lost
    in_modem = 1_000 + SIK.packet_bytes
    assert in_modem <= 4_000 - lost <= in_modem + 500 * 4_000 * 10 / 57_600 + SIK.packet_bytes


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


def test_flow_control_stops_the_host() -> None:
    """The kernel accepts no more than it holds, and nothing is lost."""
    bench = Bench(replace(SIK, has_flow_control=True, host_bytes=1_000))
    assert bench.write(LEFT, numbered(5_000)) == 1_000
    assert bench.write(LEFT, b"x") == 0
    assert bench.link.unwritten(LEFT, bench.now) == 1_000
    data, written = numbered(30_000), 1_000
    while written < len(data):
        written += bench.write(LEFT, data[written:])
        bench.run(bench.now + 0.02)
    bench.run(bench.now + 10)

    assert bytes(bench.arrived[RIGHT]) == data


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


def test_equal_seeds_have_equal_errors() -> None:
    """A run can be repeated."""
    settings = replace(SIK, byte_error_rate=0.05, byte_loss_rate=0.05, packet_loss=0.1)
    results = []
    for seed in (1, 1, 2):
        bench = Bench(settings, seed)
        bench.write(LEFT, numbered(2_000))
        bench.run(5)
        results.append(bytes(bench.arrived[RIGHT]))
    assert results[0] == results[1] != results[2]


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


def test_mavlink_mode_cuts_at_each_start_byte() -> None:
    """A packet begins with 0xFE or has none."""
    bench = Bench(replace(SIK, cuts_at_start=True, gather_s=0.05))
    bench.write(LEFT, b"ab\xfecd\xfe\xfeef")
    bench.run(2)

    assert [packet.data for packet in bench.packets] == [b"ab", b"\xfecd", b"\xfe", b"\xfeef"]
    assert bytes(bench.arrived[RIGHT]) == b"ab\xfecd\xfe\xfeef"


def test_overhead_costs_airtime() -> None:
    """One packet of 10 bytes and 20 of overhead."""
    bench = Bench(replace(SIK, packet_overhead_bytes=20))
    bench.write(LEFT, bytes(10))
    bench.run(2)

    (packet,) = bench.packets
    assert packet.end_at - packet.begin_at == pytest.approx(8 * 30 / 24_000)


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


def test_hold_can_be_released_early() -> None:
    """And is over then."""
    bench = Bench()
    bench.link.hold(RIGHT, math.inf, bench.now)
    bench.write(LEFT, b"one")
    bench.run(5)
    bench.link.release(RIGHT, bench.now)
    bench.write(LEFT, b"two")
    bench.run(6)
    assert bytes(bench.arrived[RIGHT]) == b"onetwo"
    assert bench.count(RIGHT, Fate.HELD) == 3


def test_injected_bytes_follow_what_is_on_the_line() -> None:
    """They do not cross the air."""
    bench = Bench()
    bench.link.inject(RIGHT, b"forged", bench.now)
    bench.run(1)
    assert bytes(bench.arrived[RIGHT]) == b"forged"
    assert not bench.packets
    bench.link.pull(RIGHT, bench.now)
    bench.link.inject(RIGHT, b"lost", bench.now)
    bench.run(2)
    assert bytes(bench.arrived[RIGHT]) == b"forged"


@pytest.mark.parametrize(
    "wrong",
    [
        {"packet_loss": 1.1},
        {"byte_error_rate": -0.1},
        {"byte_loss_rate": math.nan},
        {"air_bits_s": 0},
        {"line_baud": math.inf},
        {"turn_s": 0},
        {"gather_s": -1},
        {"queue_bytes": 0},
        {"chunk_bytes": 0},
    ],
)
def test_wrong_setting_is_refused(wrong: dict[str, Any]) -> None:
    """With its name."""
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ModemSettings(**wrong)
