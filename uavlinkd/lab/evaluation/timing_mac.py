"""Times tags by the length of their key: do the paper's HMAC key sizes matter?

RFC 2104, section 2: a key longer than the hash's block (64 bytes for SHA-256) is hashed first, and its hash is the
key. The daemon prepares two hash states per session, so that it computes a tag without the key.
"""

from __future__ import annotations

import hmac
import os
import time
from collections.abc import Callable
from statistics import median

from uavlinkd.core.crypto import MacKey
from uavlinkd.lab.evaluation.records import Record, Value

MAC_KEY_BITS = (256, 512, 520, 1024, 2048)
"""The lengths of the paper and of the daemon; 520 is one byte more than a block."""
MESSAGE_BYTES = (45, 280)
"""An ATTITUDE with the header of its envelope, and the largest frame."""
_BATCHES = 15


def measure_macs(tags: int) -> list[Record]:
    """Measure the seconds per tag in batches of ``tags``, for every length of key and message."""
    records = []
    for message_bytes in MESSAGE_BYTES:
        message = os.urandom(message_bytes)
        variants: list[tuple[int, str, Callable[[], object]]] = []
        for bits in MAC_KEY_BITS:
            key = os.urandom(bits // 8)
            variants.append((bits, "prepared", _prepared(key, message)))
            variants.append((bits, "from the key", _from_the_key(key, message)))
        times: list[list[float]] = [[] for _ in variants]
        # The variants alternate, so that load affects all of them equally.
        for _ in range(_BATCHES):
            for (_, _, make), batch in zip(variants, times, strict=True):
                batch.append(_seconds_a_call(make, tags))
        for (bits, how, _), batch in zip(variants, times, strict=True):
            point: dict[str, Value] = {"mac_key_bits": bits, "states": how, "message_bytes": message_bytes}
            records.append(Record("mac", point, {"tag_s": median(batch), "tag_least_s": min(batch), "tags": tags}))
    return records


def _prepared(key: bytes, message: bytes) -> Callable[[], object]:
    prepared = MacKey(key)
    return lambda: prepared.tag(message)


def _from_the_key(key: bytes, message: bytes) -> Callable[[], object]:
    return lambda: hmac.digest(key, message, "sha256")


def _seconds_a_call(make: Callable[[], object], calls: int) -> float:
    before = time.perf_counter()
    for _ in range(calls):
        make()
    return (time.perf_counter() - before) / calls
