"""What tests of other rooms see inside the MAVLink room: only this folder names its private attributes."""

from __future__ import annotations

from typing import Any

from uavlinkd.mavlink.policy.gate import Gate
from uavlinkd.mavlink.routing import Router


def remembered_frames(router: Router[Any]) -> int:
    """The number of frames that are remembered to find repetitions."""
    return len(router.sendings.seen)


def most_addresses(router: Router[Any]) -> int:
    """The number of addresses of the port with the most."""
    return max((len(addresses) for addresses in router._received_at.values()), default=0)


def gate_tables(gate: Gate) -> tuple[int, int]:
    """The numbers of remembered decisions and of buckets."""
    return len(gate._decisions), len(gate._buckets)
