"""How long a mission and parameters take over a path that loses datagrams, with and without repair, and the bytes.

``python -m tests.network.repair`` prints the table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from statistics import median
from typing import Final, NamedTuple

from tests.link.two_radios import Network, Radio
from tests.network.stand_ins import COUNT_AGAIN_S, Autopilot, Station
from uavlinkd.core.path import Path
from uavlinkd.core.settings import Link, Redundancy
from uavlinkd.link.network_budgets import wire_bytes

DELAY_S: Final = 0.01
ITEMS: Final = 100
PARAMETERS: Final = 1370
SETTLING_S: Final = 20.0
"""The link is in use before the transfer begins, so the daemons know its loss."""
PATIENCE_S: Final = 900.0
RADIOS: Final = {
    "clean": Radio(DELAY_S),
    "5 % loss": Radio(DELAY_S, 0.05),
    "10 % loss": Radio(DELAY_S, 0.1),
    "20 % loss": Radio(DELAY_S, 0.2),
    "30 % loss": Radio(DELAY_S, 0.3),
    "30 % in bursts of 3": Radio(DELAY_S, 0.3, burst=3.0),
    "30 % in bursts of 5": Radio(DELAY_S, 0.3, burst=5.0),
}


class Transfer(NamedTuple):
    """One transfer."""

    seconds: float
    """Infinity if it did not end."""
    bytes: int
    """Of all datagrams in both directions meanwhile, with IP and UDP headers."""
    repeats: int
    repeat_bytes: int
    given_up: bool
    """Whether the station waited so long for a request that QGroundControl would have given the upload up."""


def mission(radio: Radio, seed: int, *, has_repair: bool = True) -> Transfer:
    """A mission of :data:`ITEMS` items to the vehicle."""
    return _transfer(radio, seed, Station.upload, lambda vehicle, _: vehicle.stored_at is not None, has_repair)


def parameters(radio: Radio, seed: int, *, has_repair: bool = True) -> Transfer:
    """:data:`PARAMETERS` parameters to the station."""
    return _transfer(
        radio, seed, Station.read_parameters, lambda _, station: len(station.values) == PARAMETERS, has_repair
    )


def _transfer(
    radio: Radio,
    seed: int,
    begin: Callable[[Station], None],
    is_over: Callable[[Autopilot, Station], bool],
    has_repair: bool,
) -> Transfer:
    redundancy = Redundancy.CRITICAL if has_repair else Redundancy.NONE
    network = Network([radio], Link(redundancy=redundancy), seed=seed)
    network.establish()
    vehicle = Autopilot(network, network.alpha, PARAMETERS)
    station = Station(network, network.bravo, ITEMS)
    network.run(network.now + SETTLING_S)
    ends = network.alpha, network.bravo
    sent = [len(end.sent) for end in ends]
    repeats = [end.link.output.repeats for end in ends]
    before = sum(one.sent for one in repeats), sum(one.bytes_sent for one in repeats)
    began_at = network.now
    begin(station)
    while not is_over(vehicle, station) and network.now < began_at + PATIENCE_S:
        network.run(network.now + 0.01)
    size = sum(
        wire_bytes(one.datagram, Path(0, ("192.0.2.1", 1)))
        for end, number in zip(ends, sent, strict=True)
        for one in end.sent[number:]
    )
    return Transfer(
        network.now - began_at if is_over(vehicle, station) else float("inf"),
        size,
        sum(one.sent for one in repeats) - before[0],
        sum(one.bytes_sent for one in repeats) - before[1],
        station.longest_wait_s > COUNT_AGAIN_S,
    )


def _row(name: str, what: str, transfers: Sequence[Transfer]) -> str:
    seconds = sorted(one.seconds for one in transfers)
    given_up = sum(one.given_up for one in transfers)
    return (
        f"| {name} | {what} | {median(seconds):.1f} s | {seconds[-1]:.1f} s "
        f"| {median(one.bytes for one in transfers) / 1000:,.0f} kB "
        f"| {median(one.repeat_bytes for one in transfers) / 1000:,.0f} kB | {given_up} of {len(transfers)} |"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.network.repair", description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="runs for each row (20)")
    parser.add_argument("--radio", help="only rows with this text in their name")
    options = parser.parse_args(arguments)
    print("| path, each direction | transfer | median | longest | bytes | of them repeats | given up |")
    print("|---|---|---|---|---|---|---|")
    for name, radio in RADIOS.items():
        if options.radio and options.radio not in name:
            continue
        for what, run in (("mission", mission), ("parameters", parameters)):
            for has_repair in (True, False) if radio.loss else (True,):
                text = what if has_repair else f"{what}, no repair"
                transfers = [run(radio, seed, has_repair=has_repair) for seed in range(options.seeds)]
                print(_row(name, text, transfers), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
