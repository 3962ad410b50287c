"""The memory that a member of a large relay takes, in virtual time: three days of new keys each two minutes."""

from __future__ import annotations

import gc
import random
import tracemalloc
from dataclasses import replace

import pytest

from tests.protocol.harness import PLAIN, Pair, datagrams, lively
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, wire
from uavlinkd.protocol.counters import Arrivals
from uavlinkd.protocol.settings import PeerSettings

MEMBERS = 4000
HOURS = 72
EARLY_HOURS = 5
"""Until then the interpreter's own caches fill."""
BYTES_PER_MEMBER = 64 * 1024
"""With several paths; specification, section 14: 256 MB for 4,000 members."""


@pytest.mark.long
@pytest.mark.parametrize("has_paths", [False, True])
def test_three_days_of_a_member_take_no_more_memory_than_five_hours(has_paths: bool) -> None:
    """One of 4,000 members makes all its sessions; its share of what a relay remembers is that of 4,000."""
    rng = random.Random(1)
    pair = Pair(link_a=replace(PLAIN, timers=lively().timers)).establish()
    for number in range(1, MEMBERS):
        pair.b.node.add_peer(PeerSettings(f"m{number}", rng.randbytes(31) + b"\0", None, PLAIN), 0.0)
    gc.collect()
    tracemalloc.start()
    try:
        sizes = list[int]()
        for number in range(1, HOURS * 30 + 1):
            now = 120.0 * number
            rekey(pair, now, has_paths=has_paths)
            if number in (EARLY_HOURS * 30, HOURS * 30):
                gc.collect()
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    early, days = sizes
    assert days - early < 24 * 1024
    assert days < 2 * BYTES_PER_MEMBER, "both ends are here"
    assert len(pair.b.peer.remembered) == c.REMEMBERED_LEAST
    assert c.REMEMBERED_LEAST <= c.REMEMBERED_INITIATIONS // MEMBERS


def rekey(pair: Pair, now: float, *, has_paths: bool) -> None:
    """Alpha makes new keys; a few envelopes and two jumps of the counter fill the windows."""
    for side in (pair.a, pair.b):
        side.timeout(now)
    (initiation,) = datagrams(establish.initiate(pair.a.peer, now), wire.INITIATION)
    pair.complete(initiation, now)
    if has_paths:
        pair.b.session.arrivals = pair.b.session.arrivals or Arrivals(now)
    for _ in range(3):
        pair.crosses(pair.a, pair.b, now)
        pair.a.session.send_counter += c.REPLAY_WINDOW // 2
    assert pair.crosses(pair.a, pair.b, now)
