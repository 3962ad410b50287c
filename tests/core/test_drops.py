"""The reasons for which something is discarded."""

from __future__ import annotations

import re

from uavlinkd.core.drops import Drop, DropReason


def test_reason_names_are_fit_for_metrics() -> None:
    """The value is the name in lower case, so logs, status and metrics use one word for one thing."""
    for reason in DropReason:
        assert reason.value == reason.name.lower()
        assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", reason.value)


def test_a_drop_carries_its_reason() -> None:
    """A drop has its reason as an attribute and in its text."""
    drop = Drop(DropReason.BAD_TAG)

    assert drop.reason is DropReason.BAD_TAG
    assert str(drop) == "bad_tag"
