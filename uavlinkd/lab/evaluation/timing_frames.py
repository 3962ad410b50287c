"""Times frames on an established link of two real daemons: latency and processor time.

Frames are sent one by one, at a rate that leaves the link idle between them. The latency is that of a single frame,
from the ``sendto`` of a client to the arrival at another through both daemons, and the cost is an upper bound. Under
load, frames share wake-ups and envelopes, so each costs less.
"""

from __future__ import annotations

import time

from uavlinkd.lab.evaluation.machine import CpuTimeError, EnergyMeter
from uavlinkd.lab.evaluation.pair import LinkChoice, Pair, PairError
from uavlinkd.lab.evaluation.records import Record, Status, Value
from uavlinkd.lab.evaluation.timing_handshake import point_of

FRAMES_PER_S = 250.0
"""About twice the rate of a flying PX4 in its default mode."""
_LAST_S = 2.0
"""How long the last frame may take."""


def measure_frames(choice: LinkChoice, count: int, meter: EnergyMeter, *, with_relay: bool = False) -> Record:
    """Send ``count`` frames in one direction over one link, and record the latency of each delivered frame."""
    point = {**point_of(choice), "relay": with_relay}
    try:
        with Pair(choice, with_relay=with_relay) as pair:
            if pair.relay is not None:
                pair.relay.open()
            pair.wait_until_linked()
            values = _time_frames(pair, count, meter)
    except (PairError, CpuTimeError, OSError) as error:
        return Record("frames", point, {}, Status.FAILED, str(error))
    if not values["delivered"]:
        return Record("frames", point, values, Status.FAILED, "no frame arrived")
    return Record("frames", point, values)


def _time_frames(pair: Pair, count: int, meter: EnergyMeter) -> dict[str, Value]:
    pair.sink.arrived.clear()
    sent: list[tuple[bytes, float]] = []
    cpu_before = pair.cpu_s()
    meter.start()
    started_at = time.monotonic()
    for number in range(count):
        pair.loop.until(lambda: False, started_at + number / FRAMES_PER_S - time.monotonic())
        sent.append(pair.send_frame())
    pair.loop.until(lambda: len(pair.sink.arrived) >= count, _LAST_S)
    joules = meter.joules()
    cpu_after = pair.cpu_s()
    latencies = [pair.sink.arrived[frame] - at for frame, at in sent if frame in pair.sink.arrived]
    return {
        "sent": count,
        "delivered": len(latencies),
        "frames_per_s": FRAMES_PER_S,
        "cpu_initiator_s": cpu_after[0] - cpu_before[0],
        "cpu_responder_s": cpu_after[1] - cpu_before[1],
        "joules": joules,
        "latency_s": latencies,
    }
