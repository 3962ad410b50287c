"""What the filter costs and what it leaves: false refusals, and forbidden frames that span lost bytes.

The first are honest frames whose bytes accidentally contain a forbidden frame. The second come from a captured swarm
member that knows the length of a loss of 1 to 300 bytes, but not its place.

The attacker fills its payloads with a forbidden frame without its first byte. The distance to the start of each of
its frames is the length of the loss. Bytes lost directly behind a start byte then join this byte to the payload.
Without the loss no start byte precedes it, so it is not a hidden frame.
"""

from __future__ import annotations

import random
from typing import NamedTuple

from tests.mavlink.parsers.generate import Part, Recipe
from tests.mavlink.parsers.hidden_frames import Carrier, hide
from tests.mavlink.parsers.hidden_frames import frame as build
from tests.mavlink.parsers.judge import Deliverer, Judge, Stream, judge_all
from tests.mavlink.parsers.receivers import Options, Receiver
from uavlinkd.mavlink.dialect import IDS, MESSAGES
from uavlinkd.mavlink.frames import parse_frame
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source

TELEMETRY = (
    *("ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "HOME_POSITION", "VFR_HUD"),
)
_SHORTEST, _LONGEST = 12, 60
_FRAMES = 40


class Noise(NamedTuple):
    """The result: frames, bytes and refusals."""

    frames: int
    frame_bytes: int
    refused: int


def false_refusals(count: int, seed: int) -> Noise:
    """Deliver at least so many bytes of random telemetry of a swarm member."""
    rng = random.Random(seed)
    policy = {"role": "swarm-member", "system_ids": [1]}
    source, stream = Source("member", Policy(policy).incoming), DeliveredStream()
    numbers = [IDS[name] for name in TELEMETRY]
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


class Share(NamedTuple):
    """How many losses made a receiver accept a forbidden frame."""

    losses: int
    forbidden: int
    elsewhere: int
    """Forbidden frames that span no loss: there must not be any."""


def prepared(lost: int) -> Stream | None:
    """The stream of a member that knows the number of lost bytes; None if this attack needs another number."""
    for payload in range(_SHORTEST, _LONGEST + 1):
        size = payload + 12
        phase = lost % size - 10  # of the rest's start in a payload
        if 2 <= phase <= payload - 10:
            break
    else:
        return None
    home = IDS["HOME_POSITION"]
    carriers = [Carrier(home, bytearray(payload), 2) for _ in range(_FRAMES)]
    wanted = bytes((0, payload, 0, 0, 0, 255, 190)) + IDS["COMMAND_LONG"].to_bytes(3, "little")
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
    return Share(receiver.counts.losses, verdicts.counts["spanning_forbidden"], len(verdicts.breaches))
