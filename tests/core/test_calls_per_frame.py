"""How many Python functions of the core run for a frame in each direction; C functions are not counted."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest

from tests.core.harness import AT_A, FRAME, Pair, Side, datagrams, only, payloads
from uavlinkd.core.outputs import Output
from uavlinkd.core.settings import Link

LIMIT = 6


def calls_of(function: Callable[[], list[Output]]) -> tuple[list[str], list[Output]]:
    """The Python functions that a call runs, and what it returns."""
    names: list[str] = []

    def count(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            names.append(frame.f_code.co_qualname)

    sys.setprofile(count)
    try:
        outputs = function()
    finally:
        sys.setprofile(None)
    return names[1:], outputs  # without the given function


@pytest.mark.parametrize("both_directions", [False, True], ids=["one direction", "both directions"])
def test_calls_per_frame(both_directions: bool) -> None:
    """Whether frames go in one direction or both, most of them need no more calls than the limit at either end."""
    pair = Pair(link_a=Link(), link_b=Link()).establish()
    counts: list[int] = []

    def cross(sender: Side, receiver: Side, now: float) -> None:
        peer = sender.peer
        sending, outputs = calls_of(lambda: sender.node.send(peer, (FRAME,), now))
        datagram = only(datagrams(outputs))
        receiving, arrived = calls_of(lambda: receiver.node.receive(datagram, receiver.peer_at, now))
        for answer in datagrams(arrived):
            for back in datagrams(sender.receive(answer, now)):
                receiver.receive(back, now)
        assert payloads(arrived) == [FRAME]
        counts.extend((len(sending), len(receiving)))

    for number in range(400):
        now = number / 100
        for side in (pair.a, pair.b):
            other = pair.b if side is pair.a else pair.a
            for datagram in datagrams(side.timeout(now)):
                for answer in datagrams(other.receive(datagram, now)):
                    side.receive(answer, now)
        cross(pair.a, pair.b, now)
        if both_directions:
            cross(pair.b, pair.a, now)
    assert sorted(counts)[len(counts) * 9 // 10] <= LIMIT


def test_counter_sees_calls() -> None:
    """The functions that run are those of the path of a frame."""
    pair = Pair(link_a=Link(), link_b=Link()).establish()
    pair.a.send(0.1)
    peer = pair.a.peer
    sending, outputs = calls_of(lambda: pair.a.node.send(peer, (FRAME,), 0.1))
    assert sending == ["Node.send", "send_frames", "seal", "Session.seal", "envelope_header", "<lambda>"]
    datagram = only(datagrams(outputs))
    receiving, _ = calls_of(lambda: pair.b.node.receive(datagram, AT_A, 0.1))
    path = ["parse_envelope_header", "receive_envelope", "Session.open", "ReplayWindow.mark", "<lambda>"]
    assert receiving == ["Node.receive", *path]
