"""``python -m tests.modem``: MAVLink signing on bare modems, and uavlinkd on the same ones, in one run.

python -m tests.modem                            both radios, three loads: half a minute
python -m tests.modem --seconds 600 --out FILE   longer, with one JSON record per line in FILE
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.modem.measure import Result, on_bare_line, through_daemons
from tests.modem.offered import telemetry_bytes_s
from uavlinkd.config.serial_rules import SENDING_SHARE
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
HEADINGS: Final = (
    "load",
    "",
    "linked after",
    "telemetry offered",
    "delivered",
    "its heartbeats",
    "heartbeats, commands to it",
    "bytes per frame",
    "frames in all bytes",
    "age: median, oldest",
    "lost in the queue",
)
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
    """Measure and print. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.modem", description="What emulated modems carry.")
    parser.add_argument("--seconds", type=float, default=120.0, help="virtual time of each run (120)")
    parser.add_argument("--out", type=Path, help="also write one JSON record per run to this file")
    options = parser.parse_args(arguments)
    records: list[str] = []
    for radio in RADIOS:
        for line in table(radio, options.seconds, records):
            print(line, flush=True)
    if options.out is not None:
        options.out.write_text("".join(f"{record}\n" for record in records))
    return 0


def factor_of(modem: ModemSettings, load: float) -> float:
    """The factor of the telemetry's rates that makes this load."""
    return load * SENDING_SHARE * modem.air_bits_s / 8 / telemetry_bytes_s()


def table(radio: str, seconds: float, records: list[str]) -> Iterator[str]:
    """The lines of one radio, in Markdown. Adds the records as JSON."""
    modem = RADIOS[radio]
    yield f"\n{radio}\n"
    yield f"| {' | '.join(HEADINGS)} |"
    yield "|---|---|---|---|---|---|---|---|---|---|---|"
    for load in LOADS:
        for name, measure in CONTENDERS.items():
            result = measure(modem, seconds, factor_of(modem, load))
            records.append(json.dumps({"radio": radio, "load": load, "contender": name, **asdict(result)}))
            yield row(load, name, result)


def row(load: float, name: str, result: Result) -> str:
    """One line of the table."""
    cells = (
        f"{load:g}",
        name,
        f"{result.linked_after_s:.1f} s",
        f"{result.offered_s:.1f}/s",
        f"{result.delivered_s:.1f}/s",
        f"{result.critical_vehicle:.0%}",
        f"{result.critical_station:.0%}",
        f"{result.bytes_per_frame:.0f}",
        f"{result.frame_share:.0%}",
        f"{result.median_s:.2f}, {result.oldest_s:.2f} s",
        f"{result.lost_in_queue:,} B",
    )
    return f"| {' | '.join(cells)} |"
