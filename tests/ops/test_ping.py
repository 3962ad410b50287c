"""``uavlinkd ping``: what it writes about each path."""

from __future__ import annotations

from typing import Any

import pytest

from uavlinkd.ops.ping import INTERVAL_S, ping

DIRECT: dict[str, Any] = {
    "address": "203.0.113.7:5790",
    "relay": None,
    "network": "lte",
    "answered_s": 1.02,  # at once, an interval ago
    "round_trip_s": 0.0234,
    "loss_in": 0.0,
    "loss_out": 0.02,
    "carries": ["critical", "stream", "bulk"],
}
RELAYED = {
    **DIRECT,
    "number": 1,
    "address": "relayed via vps",
    "relay": "vps",
    "relay_address": "198.51.100.2:5790",
    "network": None,
    "carries": ["critical"],
}
SILENT = {**RELAYED, "answered_s": 3.0, "carries": []}


@pytest.mark.parametrize(("paths", "is_answered"), [([DIRECT, SILENT], True), ([SILENT], False), ([], False)])
def test_each_question_has_a_line_for_each_path(paths: list[dict[str, Any]], is_answered: bool) -> None:
    """The answers to the first question are shown a second later."""
    lines: list[str] = []
    slept: list[float] = []
    assert ping(lambda: {"paths": paths}, 3, lines.append, slept.append) is is_answered
    assert slept == [INTERVAL_S] * 3
    assert len(lines) == 3 * max(1, len(paths))
    assert lines[-1].startswith("3: ")
    if len(paths) == 2:
        assert lines[:2] == [
            "1: direct to 203.0.113.7:5790 on lte, 23.4 ms, loss 0 % in, 2 % out, carries critical and stream and"
            " bulk",
            "1: relayed via vps, no answer, loss 0 % in, 2 % out, carries no frames",
        ]
