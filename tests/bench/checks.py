"""The figures to reach, and whether they are reached."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from tests.bench.findings import BASELINE, SIDES, Findings

OURS: Final = "uavlinkd"
COALESCED: Final = "uavlinkd-coalesced"
SIDE_NAMES: Final = {"left": "sending side", "right": "receiving side"}
MAX_RATIO: Final = 1.3
MAX_RESIDENT: Final = 60e6
MAX_START_S: Final = 0.75
MAX_PEERS_RATIO: Final = 1.2
MIN_HIGHEST_RATIO: Final = 3.0


@dataclass(frozen=True, slots=True)
class Check:
    """One figure, and its limit; either is None where it was not measured."""

    what: str
    figure: float | None
    limit: float | None
    unit: str
    at_least: bool = False
    strictly: bool = False
    """The limit itself does not do."""

    @property
    def is_reached(self) -> bool | None:
        """None where it cannot be said."""
        if self.figure is None or self.limit is None:
            return None
        if self.strictly and self.figure == self.limit:
            return False
        return self.figure >= self.limit if self.at_least else self.figure <= self.limit

    @property
    def verdict(self) -> str:
        """In words: reached, or by how much not."""
        if self.is_reached is None or self.figure is None or self.limit is None:
            return "not measured"
        if self.is_reached:
            return "reached"
        if not self.limit or not self.figure:
            return "not reached"
        factor = self.limit / self.figure if self.at_least else self.figure / self.limit
        return f"not reached: {factor:.2f} times too {'little' if self.at_least else 'much'}"


def all_checks(findings: Findings) -> list[Check]:
    """Every one, in the order in which they are asked for."""
    return [*_cpu(findings), *_highest(findings), *_coalesced(findings), *_latency(findings), *_scale(findings)]


def _cpu(findings: Findings) -> Iterator[Check]:
    for side in SIDES:
        ours = findings.cpu_us(OURS, 1_000, side)
        at = f"CPU of a frame at 1,000/s, {SIDE_NAMES[side]}"
        for other in ("wireguard-go", "nebula"):
            yield Check(f"{at}: below {other}", ours, findings.cpu_us(other, 1_000, side), "µs", strictly=True)
        yield Check(
            f"{at}: at most {MAX_RATIO:g} times the uvloop relay",
            ours,
            _times(findings.cpu_us(BASELINE, 1_000, side), MAX_RATIO),
            "µs",
        )
    for side in SIDES:
        yield Check(
            f"CPU of a frame at 10,000/s, {SIDE_NAMES[side]}: at most the uvloop relay",
            findings.cpu_us(OURS, 10_000, side),
            findings.cpu_us(BASELINE, 10_000, side),
            "µs",
        )


def _highest(findings: Findings) -> Iterator[Check]:
    limit = _times(findings.highest("wireguard-go", 1), MIN_HIGHEST_RATIO)
    what = f"highest rate without loss: at least {MIN_HIGHEST_RATIO:g} times wireguard-go"
    yield Check(what, findings.highest(OURS, 1), limit, "/s", at_least=True)


def _coalesced(findings: Findings) -> Iterator[Check]:
    def wire(name: str) -> float | None:
        return findings.median("rate", "wire_bytes_per_frame", contender=name, rate=1_000)

    plain = wire("plain-udp") or wire(BASELINE)
    yield Check(
        "2 ms coalescing, 1,000/s: bytes of a frame below plain UDP", wire(COALESCED), plain, "B", strictly=True
    )
    for side in SIDES:
        yield Check(
            f"2 ms coalescing, 1,000/s: CPU of a frame below the uvloop relay, {SIDE_NAMES[side]}",
            findings.cpu_us(COALESCED, 1_000, side),
            findings.cpu_us(BASELINE, 1_000, side),
            "µs",
            strictly=True,
        )


def _latency(findings: Findings) -> Iterator[Check]:
    for part, name in ((0.5, "p50"), (0.99, "p99")):
        ours, other = (_times(findings.latency_s(name, 1_000, part), 1e6) for name in (OURS, "wireguard-go"))
        yield Check(f"latency at 1,000/s, {name}: below wireguard-go", ours, other, "µs", strictly=True)


def _scale(findings: Findings) -> Iterator[Check]:
    lost = findings.numbers("peers", "loss", peers=200)
    yield Check("200 peers of 50/s: no loss", max(lost) * 100 if lost else None, 0.0, "%")
    many = findings.median("peers", "cpu_right_us", peers=200)
    for rate, how in ((50.0, "50/s each"), (5_000.0, "5,000/s each, the same in sum")):
        few = findings.median("peers", "cpu_right_us", peers=2, rate_each=rate)
        what = f"200 peers of 50/s: CPU of a frame within {MAX_PEERS_RATIO:g} times that with 2 peers of {how}"
        yield Check(what, many, _times(few, MAX_PEERS_RATIO), "µs")
    memory = findings.median("memory", "rss", peers=10)
    limit = MAX_RESIDENT / 1e6
    yield Check(f"memory with 10 peers: below {limit:g} MB", _times(memory, 1e-6), limit, "MB", strictly=True)
    start = findings.median("start", "ready_s")
    what = f"from exec to ready: under {MAX_START_S:g} s"
    yield Check(what, _times(start, 1e3), MAX_START_S * 1e3, "ms", strictly=True)


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor
