"""``python -m tests.modem``: MAVLink signing on bare modems, and uavlinkd on the same ones, in one run."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, fields, replace
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.modem.measure import Result, on_bare_line, through_daemons
from tests.modem.offered import telemetry_bytes_s
from uavlinkd.config.network_rules import SENDING_SHARE
from uavlinkd.core.settings import Link
from uavlinkd.lab.mitm.modem import ModemSettings
from uavlinkd.mavlink.egress.budgeted import EgressSettings

SIK: Final = ModemSettings()
SLOW: Final = replace(SIK, air_bits_s=4_000.0, turn_around_s=0.05)
NOISY: Final = replace(SIK, packet_loss=0.02, byte_error_rate=0.0005, byte_loss_rate=0.0002)
RADIOS: Final[Mapping[str, ModemSettings]] = {
    "24 kbit/s": SIK,
    "24 kbit/s, 2 % of packets lost, 0.05 % of bytes altered": NOISY,
    "4 kbit/s, turn-around 50 ms": SLOW,
}
LOADS: Final = (0.5, 1.0, 3.0)
"""Offered telemetry, as multiples of what one end may send by default: 40 % of the radio's rate."""
SAVING: Final = EgressSettings(coalesce_s=0.25), Link(tag_bytes=12)
"""Frames wait 0.25 s for each other, and tags have 96 bits."""
Measure = Callable[[ModemSettings, float, float], Result]
CONTENDERS: Final[Mapping[str, Measure]] = {
    "MAVLink signing": on_bare_line,
    "MAVLink signing, pymavlink": lambda modem, seconds, factor: on_bare_line(
        modem, seconds, factor, mavlink.MAVLink
    ),
    "uavlinkd, defaults": through_daemons,
    "uavlinkd, coalesced": lambda modem, seconds, factor: through_daemons(modem, seconds, factor, *SAVING),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print a table in Markdown. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.modem", description="What emulated modems carry.")
    parser.add_argument("--seconds", type=float, default=120.0, help="virtual time of each run (120)")
    seconds = parser.parse_args(arguments).seconds
    names = [field.name for field in fields(Result)]
    print(f"| radio | load | | {' | '.join(names)} |\n|{'---|' * (3 + len(names))}")
    for radio, modem in RADIOS.items():
        for load in LOADS:
            for name, measure in CONTENDERS.items():
                result = astuple(measure(modem, seconds, factor_of(modem, load)))
                print(
                    f"| {radio} | {load:g} | {name} | {' | '.join(f'{value:.3g}' for value in result)} |", flush=True
                )
    return 0


def factor_of(modem: ModemSettings, load: float) -> float:
    """The factor of the telemetry's rates that makes this load."""
    return load * SENDING_SHARE * modem.air_bits_s / 8 / telemetry_bytes_s()
