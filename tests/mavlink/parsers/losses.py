"""The remaining risk: frames that span lost bytes. Measures how often a receiver accepts a forbidden one.

``python -m tests.mavlink.parsers.losses`` measures it for honest telemetry and random losses of 1 to 300 bytes, and
for a captured swarm member that knows the length of the loss, but not its place.

The attacker fills its payloads with a forbidden frame without its first byte. The distance to the start of each of
its frames is the length of the loss. Bytes lost directly behind a start byte then join this byte to the payload.
Without the loss no start byte precedes it, so it is not a hidden frame.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Sequence
from statistics import mean
from typing import NamedTuple

from tests.mavlink.parsers.generate import Part, Recipe
from tests.mavlink.parsers.judge import Deliverer, Judge, Stream, judge_all
from tests.mavlink.parsers.noise import TELEMETRY
from tests.mavlink.parsers.receivers import LONGEST_LOSS, Options, Receiver
from uavlinkd.lab.evaluation.hidden_frames import Carrier, hide
from uavlinkd.lab.evaluation.hidden_frames import frame as build
from uavlinkd.mavlink.dialect import ids_by_name
from uavlinkd.mavlink.dialect_table import MESSAGES

_SHORTEST, _LONGEST = 12, 60
_FRAMES = 40


class Share(NamedTuple):
    """How many losses made a receiver accept a forbidden frame."""

    losses: int
    forbidden: int
    elsewhere: int
    """Forbidden frames that span no loss: there must not be any."""


def of_honest_telemetry(streams: int, losses: int, seed: int) -> Share:
    """Random telemetry of one swarm member, `mavlink_parse_char`, random losses."""
    rng = random.Random(seed)
    numbers = [ids_by_name()[name] for name in TELEMETRY]
    receiver, judge, deliverer = Receiver("common", "2.0"), Judge(), Deliverer()
    forbidden = elsewhere = 0
    for _ in range(streams):
        chosen = rng.choices(numbers, k=_FRAMES)
        parts = tuple(Part("member", build(frame, rng.randbytes(MESSAGES[frame][3]), 2)) for frame in chosen)
        stream = deliverer.deliver(Recipe(0, parts))
        verdicts = judge_all([stream], [receiver], judge, every_offset=False, losses=losses, seed=rng.getrandbits(60))
        forbidden += verdicts.spanning_forbidden
        elsewhere += len(verdicts.breaches)
    return Share(receiver.counts.losses, forbidden, elsewhere)


def prepared(lost: int) -> Stream | None:
    """The stream of a member that knows the number of lost bytes; None if this attack needs another number."""
    for payload in range(_SHORTEST, _LONGEST + 1):
        size = payload + 12
        phase = lost % size - 10  # of the rest's start in a payload
        if 2 <= phase <= payload - 10:
            break
    else:
        return None
    home = ids_by_name()["HOME_POSITION"]
    carriers = [Carrier(home, bytearray(payload), 2) for _ in range(_FRAMES)]
    wanted = bytes((0, payload, 0, 0, 0, 255, 190)) + ids_by_name()["COMMAND_LONG"].to_bytes(3, "little")
    for number in range(_FRAMES - 1):
        hide(carriers[number : number + 2], wanted + bytes(payload + 2), 10 + phase)
    raws = [carrier.build() for carrier in carriers]
    return Deliverer().deliver(Recipe(0, tuple(Part("member", raw) for raw in raws)))


def of_attacker(lost: int) -> Share:
    """Apply the loss at each offset of the attacker's stream."""
    stream = prepared(lost)
    if stream is None:
        return Share(1, 0, 0)
    receiver = Receiver("common", "2.0", Options())
    verdicts = judge_all([stream], [receiver], Judge(), every_offset=True, losses=-1 - lost)
    return Share(receiver.counts.losses, verdicts.spanning_forbidden, len(verdicts.breaches))


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0, or 1 if a forbidden frame that spans no loss was accepted."""
    parser = argparse.ArgumentParser(prog="python -m tests.mavlink.parsers.losses", description=__doc__)
    parser.add_argument("--losses", type=int, default=2_000_000, help="random ones of honest telemetry (2000000)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    per_stream = 2000
    honest = of_honest_telemetry(max(1, options.losses // per_stream), per_stream, options.seed)
    print(f"honest telemetry: {honest.forbidden} forbidden frames after {honest.losses:,} random losses")
    result = {lost: of_attacker(lost) for lost in range(1, LONGEST_LOSS + 1)}
    shares = {lost: share.forbidden / share.losses for lost, share in result.items()}
    best = max(shares, key=lambda lost: shares[lost])
    print(
        f"attacker that knows the length: {100 * mean(shares.values()):.1f} % of the offsets on average, "
        f"{100 * shares[best]:.1f} % at best (a loss of {best} bytes); "
        f"lengths without success: {sum(not share for share in shares.values())} of {LONGEST_LOSS}"
    )
    elsewhere = honest.elsewhere + sum(share.elsewhere for share in result.values())
    print(f"forbidden frames that span no loss: {elsewhere}")
    return 1 if elsewhere else 0


if __name__ == "__main__":
    sys.exit(main())
