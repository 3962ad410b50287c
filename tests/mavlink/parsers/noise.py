"""Random telemetry: how many honest frames are refused because their bytes accidentally contain a forbidden frame.

``python -m tests.mavlink.parsers.noise --bytes 100000000`` measures it.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

from uavlinkd.lab.evaluation.hidden_frames import frame as build
from uavlinkd.mavlink.dialect import ids_by_name
from uavlinkd.mavlink.dialect_table import MESSAGES
from uavlinkd.mavlink.frames import parse_frame
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source

TELEMETRY = (
    *("ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "HOME_POSITION", "VFR_HUD"),
)
_CHUNK = 5_000_000


class Noise(NamedTuple):
    """The result: frames, bytes and refusals."""

    frames: int
    frame_bytes: int
    refused: int


def false_refusals(count: int, seed: int, allow_in: Sequence[object] = ()) -> Noise:
    """Deliver at least so many bytes of random telemetry of a swarm member; ``allow_in``: what else it may send."""
    rng = random.Random(seed)
    policy = {"role": "swarm-member", "system_ids": [1], "allow_in": list(allow_in)}
    source, stream = Source("member", compile_policy(policy).incoming), DeliveredStream()
    numbers = [ids_by_name()[name] for name in TELEMETRY]
    frames = total = refused = 0
    while total < count:
        msgid = numbers[frames % len(numbers)]
        raw = build(msgid, rng.randbytes(MESSAGES[msgid][3]), 1, version=1 if frames % 8 == 7 else 2)
        parsed = parse_frame(raw)
        if parsed is None or not parsed.header.is_known:
            raw = build(msgid, rng.randbytes(MESSAGES[msgid][2]), 1, version=1)
            parsed = parse_frame(raw)
            assert parsed is not None
        total += len(raw)
        frames += 1
        refused += stream.admit(parsed, source, float(frames)) != raw
    return Noise(frames, total, refused)


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.mavlink.parsers.noise", description=__doc__)
    parser.add_argument("--bytes", type=int, default=10_000_000, help="of frames (10000000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument("--unknown", action="store_true", help="with a policy that lets an unknown message pass")
    options = parser.parse_args(arguments)
    allow_in = (54321,) if options.unknown else ()
    sizes = [min(_CHUNK, options.bytes - begin) for begin in range(0, options.bytes, _CHUNK)]
    with ProcessPoolExecutor(options.jobs) as pool:
        begun = [
            pool.submit(false_refusals, size, options.seed * 100_000 + number, allow_in)
            for number, size in enumerate(sizes)
        ]
        result = [future.result() for future in begun]
    frames, total, refused = (sum(column) for column in zip(*result, strict=True))
    print(f"{frames:,} frames, {total:,} bytes: {refused:,} refused, one in {frames / max(1, refused):,.0f} frames")
    return 0


if __name__ == "__main__":
    sys.exit(main())
