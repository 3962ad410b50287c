"""Relays that are killed under running links of real daemons, which have no other path to each other."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import pairwise
from time import monotonic
from typing import Any

import pytest

from tests.daemon.fleet import relay_for
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess, Status
from tests.faults.talk import CriticalVoice, Talk, Voice, prepare
from tests.waiting import Stopwatch

BACK_WITHIN_S = 4.0
"""From when the relay listens again."""
STREAM_GAP_S = 0.5
AFTER_S = 3.0
"""The path along a dead relay is down within this time."""


@dataclass(frozen=True, slots=True)
class Link:
    """Two daemons that talk through relays."""

    daemons: tuple[DaemonProcess, DaemonProcess]
    relays: list[DaemonProcess]
    talk: Talk

    async def carrying(self) -> DaemonProcess:
        """The relay that carries what the first daemon sends, once both daemons can use all relays."""
        for daemon in self.daemons:
            await daemon.until(lambda status: len(_usable(status)) == len(self.relays))
        status = await self.daemons[0].until(lambda status: any(map(_carries_stream, _usable(status))))
        name = next(path["relay"] for path in _usable(status) if _carries_stream(path))
        return next(relay for relay in self.relays if relay.name == name)


@asynccontextmanager
async def linked(relays: int, voice: type[Voice]) -> AsyncIterator[Link]:
    """Two daemons, started and linked through relays, and their clients, which talk."""
    async with Stage() as stage:
        one, other = stage.daemon("drone0"), stage.daemon("drone1")
        psk = stage.psk()
        one.add_peer(other, [], psk)
        other.add_peer(one, [], psk)
        talk = prepare(one, other, voice=voice)
        between = [relay_for(stage, one, other, name=f"relay{number}") for number in range(relays)]
        await stage.start(*between, linked=False)
        await stage.start(one, other)
        try:
            await talk.start()
            yield Link((one, other), between, talk)
        finally:
            talk.stop()


def _usable(status: Status) -> list[dict[str, Any]]:
    (peer,) = status["peers"].values()
    return [path for path in peer["paths"] if path["state"] == "usable"]


def _carries_stream(path: dict[str, Any]) -> bool:
    return "stream" in path["carries"]


async def test_link_is_back_when_its_only_relay_is() -> None:
    """In both directions. The relay remembers nothing; no frame arrives twice."""
    async with linked(1, Voice) as link:
        (relay,) = link.relays
        for _ in range(2):
            await relay.kill()
            await relay.start()
            await relay.ready()
            assert await link.talk.back(monotonic()) < BACK_WITHIN_S
        link.talk.check_no_copies()


async def test_dead_relay_of_two_costs_no_critical_frame() -> None:
    """Both relays have copies of each, and it arrives once."""
    async with linked(2, CriticalVoice) as link:
        relay = await link.carrying()
        began = monotonic()
        await relay.kill()
        await asyncio.sleep(AFTER_S)
        await link.talk.check_lost_none(began, monotonic(), *link.daemons)
        link.talk.check_no_copies()


@pytest.mark.long
async def test_dead_relay_of_two_interrupts_the_stream_shortly() -> None:
    """Frames of telemetry have no copies: some are lost until probes show it."""
    async with linked(2, Voice) as link:
        relay = await link.carrying()
        watch, began = Stopwatch(), monotonic()
        await relay.kill()
        await asyncio.sleep(AFTER_S)
        await link.talk.back(monotonic())
        for voice in link.talk.voices:
            arrivals = [began, *(at for at in voice.received_at.values() if at > began)]
            assert max(later - earlier for earlier, later in pairwise(arrivals)) < STREAM_GAP_S + watch.contended_s
        link.talk.check_no_copies()
