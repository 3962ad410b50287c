"""All members of a relay look for it at once: their handshakes do not keep the first sessions waiting."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import cast

import pytest

from tests.core.harness import AT_A
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Dropped, Output
from uavlinkd.core.path import Path
from uavlinkd.core.wire import ENVELOPE_STARTS
from uavlinkd.link import intake
from uavlinkd.link.intake import Intake
from uavlinkd.link.switch import Switch
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch

ENVELOPE = min(ENVELOPE_STARTS)
HANDSHAKES = [bytes((1, number)) for number in range(5)]
"""Initiations, the oldest first."""


async def received(datagrams: list[bytes]) -> tuple[list[bytes], list[Output]]:
    """In what order a core gets datagrams that were read together, and what is refused."""
    given: list[bytes] = []
    refused: list[Output] = []

    def receive(datagram: bytes, path: Path, now: float) -> list[Output]:
        given.append(datagram)
        return []

    def refuse(datagram: bytes, path: Path) -> Dropped:
        assert datagram not in given
        return Dropped(DropReason.OVER_SHARE, None, path)

    node = SimpleNamespace(receive=receive, refuse=refuse, claimed_sender=lambda *_: 0)
    never = cast("Switch", SimpleNamespace())
    stall = StallWatch(monotonic(), lambda _: None)
    taker = Intake(
        *(cast("Node", node), stall, never, {}, refused.extend),
        *(lambda *_: None, lambda: None, lambda *_: None, lambda *_: None),
    )
    taker.receive(AT_A.socket, [(datagram, AT_A.address) for datagram in datagrams], monotonic(), 0, 0.0)
    for _ in range(2 * len(datagrams)):
        await asyncio.sleep(0)
    return given, refused


async def test_they_are_handled_in_order_while_there_is_time() -> None:
    """Before the envelopes, which their senders repeat less soon."""
    assert await received([ENVELOPE, *HANDSHAKES]) == ([*HANDSHAKES, ENVELOPE], [])


async def test_envelopes_come_before_those_for_which_there_is_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then the newest come first: their senders still wait for them."""
    monkeypatch.setattr(intake, "HANDSHAKES_S", 0.0)
    first, *others = HANDSHAKES
    assert await received([*HANDSHAKES, ENVELOPE]) == ([first, ENVELOPE, *others[::-1]], [])


async def test_too_many_are_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest."""
    monkeypatch.setattr(intake, "HANDSHAKES_S", 0.0)
    monkeypatch.setattr(intake, "WAITING_HANDSHAKES", 2)
    given, refused = await received(HANDSHAKES)
    assert given == [HANDSHAKES[0], HANDSHAKES[4], HANDSHAKES[3]]
    assert refused == [Dropped(DropReason.OVER_SHARE, None, AT_A)] * 2
