"""Daemons in the laboratory that know only a relay: when it connects them, when they are direct, what they lose."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Final

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess, Status
from tests.faults.talk import Talk, prepare
from tests.natlab.laboratory import Place
from tests.natlab.pairs import Pair

NEVER_S: Final = 10.0
"""From when both daemons reached the relay, or after which they will not."""
TALK_S: Final = 1.0
"""How long frames are counted after the first ones have arrived."""
RELAY: Final = "vps"
PORT: Final = 5790
_POLL_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a pair did. Times in seconds from when both daemons had reached the relay; None for never."""

    relayed_s: float | None = None
    """Until each has received a frame of the other."""
    direct_s: float | None = None
    """Until both send along a direct path."""
    sent: int = 0
    lost: int = 0
    """Of the frames of both, from the first that arrived on."""


@dataclass(frozen=True, slots=True)
class _Ends:
    daemons: tuple[DaemonProcess, DaemonProcess]
    talk: Talk


async def connect_all(
    pairs: Sequence[Pair], public: Place, *, direct_limit_s: float, at_once: int
) -> dict[Pair, Outcome]:
    """Run a relay on a public host, and two daemons for each pair."""
    turn = asyncio.Semaphore(at_once)

    async def connect(ends: _Ends) -> Outcome:
        async with turn:
            return await _connect(ends, direct_limit_s)

    async with Stage() as stage:
        relay = _relay(stage, public)
        ends = [_ends(stage, relay, pair, PORT + number) for number, pair in enumerate(pairs)]
        await stage.start(relay, linked=False)
        return dict(zip(pairs, await asyncio.gather(*map(connect, ends)), strict=True))


def _relay(stage: Stage, public: Place) -> DaemonProcess:
    relay = stage.daemon(RELAY, [f"{public.address}:{PORT}"])
    relay.command = "relay"
    relay.launcher = public.host.launcher
    del relay.config["endpoint"], relay.config["peer"]
    relay.config["member"] = []
    return relay


def _ends(stage: Stage, relay: DaemonProcess, pair: Pair, port: int) -> _Ends:
    """The daemons of a pair. A place has one in each of its pairs, so each pair has its own port."""
    daemons = []
    for side, place in zip("ab", pair.places, strict=True):
        daemon = stage.daemon(f"{side}{port}", [f"0.0.0.0:{port}"])
        daemon.launcher = place.host.launcher
        daemon.config["relay"] = [
            {"name": RELAY, "public_key": relay.public_key, "addresses": [relay.address]},
        ]
        relay.config["member"].append({"name": daemon.name, "public_key": daemon.public_key})
        daemons.append(daemon)
    one, other = daemons
    psk = stage.psk()
    one.add_peer(other, [], psk)
    other.add_peer(one, [], psk)
    namespaces = (Path("/run/netns", place.host.name) for place in pair.places)
    return _Ends((one, other), prepare(one, other, (next(namespaces), next(namespaces))))


async def _connect(ends: _Ends, direct_limit_s: float) -> Outcome:
    talking = asyncio.create_task(ends.talk.start())
    try:
        await asyncio.gather(*(daemon.start() for daemon in ends.daemons))
        try:
            for daemon in ends.daemons:
                await daemon.ready()
                await daemon.until_logged("relay_up", timeout_s=NEVER_S)
            reached_at = monotonic()
            async with asyncio.timeout(NEVER_S):
                await talking
        except TimeoutError:
            return Outcome()
        first_at = max(min(voice.received_at.values()) for voice in ends.talk.voices)
        direct_at = await _until_direct(ends.daemons, direct_limit_s)
        await asyncio.sleep(TALK_S)
        end = monotonic()
        await ends.talk.back(end)
        return Outcome(
            max(0.0, first_at - reached_at),
            None if direct_at is None else max(0.0, direct_at - reached_at),
            sum(first_at <= at < end for voice in ends.talk.voices for at in voice.sent_at.values()),
            ends.talk.lost(first_at, end),
        )
    finally:
        talking.cancel()
        with suppress(asyncio.CancelledError):
            await talking
        ends.talk.stop()
        for daemon in ends.daemons:
            if daemon.is_running:
                assert await daemon.stop() == 0


async def _until_direct(daemons: Sequence[DaemonProcess], limit_s: float) -> float | None:
    end = monotonic() + limit_s
    while monotonic() < end:
        if all([_is_direct(await daemon.status()) for daemon in daemons]):
            return monotonic()
        await asyncio.sleep(_POLL_S)
    return None


def _is_direct(status: Status) -> bool:
    (peer,) = status["peers"].values()
    return any(path["relay"] is None and "stream" in path["carries"] for path in peer["paths"])
