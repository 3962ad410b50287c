"""How long a modem lowers CTS, in virtual time."""

from __future__ import annotations

from uavlinkd.endpoints.cts_hold import CtsHold


def test_time_counts_between_looks_that_find_bytes() -> None:
    """From the first look that finds them to the one that finds none."""
    cts = CtsHold()
    for now, is_held in ((1.0, False), (2.0, True), (2.5, True), (4.0, False), (9.0, False)):
        cts.note(now, is_held=is_held)
    assert cts.total_s == 2.0
    cts.note(10.0, is_held=True)
    assert (cts.total_s, cts.lasts_s(13.0)) == (2.0, 3.0)


def test_closed_device_ends_it() -> None:
    """The time until it is open again does not count."""
    cts = CtsHold()
    cts.note(1.0, is_held=True)
    cts.note(2.0, is_held=True)
    cts.end()
    assert cts.lasts_s(50.0) == 0.0
    cts.note(50.0, is_held=True)
    assert cts.total_s == 1.0
