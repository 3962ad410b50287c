"""The cost of tags, timed."""

from __future__ import annotations

import hmac

from uavlinkd.lab.evaluation.timing_mac import MAC_KEY_BITS, MESSAGE_BYTES, _from_the_key, _prepared, measure_macs


def test_every_key_is_measured_in_both_variants_for_every_message() -> None:
    """No point is missing, and every number is positive."""
    records = measure_macs(5)
    points = {tuple(record.point.values()) for record in records}
    assert points == {
        (bits, states, size)
        for bits in MAC_KEY_BITS
        for states in ("prepared", "from the key")
        for size in MESSAGE_BYTES
    }
    assert all(0 < record.number("tag_least_s") <= record.number("tag_s") for record in records)


def test_both_variants_make_the_same_tag_and_a_key_beyond_a_block_is_hashed() -> None:
    """RFC 2104, section 2: what the two are compared for is one and the same function."""
    for bits in MAC_KEY_BITS:
        key = bytes(range(256))[: bits // 8]
        expected = hmac.digest(key, b"message", "sha256")
        assert _prepared(key, b"message")() == _from_the_key(key, b"message")() == expected
