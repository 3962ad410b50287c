"""Daemons in the laboratory that know only a relay: when it connects them, when they are direct, what they lose."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Final

from tests.faults.talk import Talk, Voice, prepare
from tests.natlab.laboratory import Place
from tests.natlab.pairs import Pair
from tests.processes import fleet
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from tests.processes.tls import listen_for_tls

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

    linked_s: float | None = None
    """Until each has received a frame of the other; from when both daemons had started."""
    relayed_s: float | None = None
    """The same, from when both had reached the relay."""
    direct_s: float | None = None
    """Until both send along a direct path."""
    direct_to: str = ""
    """The address to which the first one sends then."""
    sent: int = 0
    lost: int = 0
    """Of the frames of both, from the first that arrived on."""


@dataclass(frozen=True, slots=True)
class Ends:
    daemons: tuple[DaemonProcess, DaemonProcess]
    talk: Talk


async def connect_all(
    pairs: Sequence[Pair], public: Place, *, direct_limit_s: float, at_once: int, tls: bool = False
) -> dict[Pair, Outcome]:
    """Run a relay on a public host, and two daemons for each pair. ``tls``: they may reach it by TLS too."""
    turn = asyncio.Semaphore(at_once)

    async def connect(ends: Ends) -> Outcome:
        async with turn:
            return await _connect(ends, direct_limit_s)

    async with Stage() as stage:
        relay = make_relay(stage, public)
        ends = [make_ends(stage, relay, pair.places, PORT + number) for number, pair in enumerate(pairs)]
        if tls:
            url = listen_for_tls(relay, public.address, 443)
            for daemon in (daemon for one in ends for daemon in one.daemons):
                daemon.config["relay"][0]["addresses"] = [*daemon.config["relay"][0]["addresses"], url]
        await stage.start(relay, linked=False)
        return dict(zip(pairs, await asyncio.gather(*map(connect, ends)), strict=True))


def make_relay(stage: Stage, public: Place) -> DaemonProcess:
    relay = stage.daemon(RELAY, _addresses(public, public.address, public.ipv6, PORT))
    relay.launcher = public.host.launcher
    fleet.make_relay(relay)
    return relay


def make_ends(
    stage: Stage, relay: DaemonProcess, places: tuple[Place, Place], port: int, voice: type[Voice] = Voice
) -> Ends:
    """Two members of a relay that are peers. A place has one in each of its pairs, so each pair has its own port."""
    daemons = []
    for side, place in zip("ab", places, strict=True):
        daemon = make_member(stage, relay, f"{side}{port}", _addresses(place, "0.0.0.0", "::", port), place)
        daemons.append(daemon)
    one, other = daemons
    psk = stage.psk()
    one.add_peer(other, [], psk)
    other.add_peer(one, [], psk)
    namespaces = places[0].host.path, places[1].host.path
    return Ends((one, other), prepare(one, other, namespaces, voice))


def make_member(stage: Stage, relay: DaemonProcess, name: str, listen: Sequence[str], place: Place) -> DaemonProcess:
    daemon = stage.daemon(name, listen)
    daemon.launcher = place.host.launcher
    addresses = relay.config["listen"] if place.ipv6 else [relay.address]
    daemon.config["relay"] = [{"name": RELAY, "public_key": relay.public_key, "addresses": addresses}]
    relay.config["member"].append({"name": name, "public_key": daemon.public_key})
    return daemon


def _addresses(place: Place, ipv4: str, ipv6: str, port: int) -> list[str]:
    """One, or two on a host with IPv6."""
    return [f"{ipv4}:{port}", *([f"[{ipv6}]:{port}"] if place.ipv6 else [])]


async def _connect(ends: Ends, direct_limit_s: float) -> Outcome:
    talking = asyncio.create_task(ends.talk.start())
    try:
        await asyncio.gather(*(daemon.start() for daemon in ends.daemons))
        try:
            for daemon in ends.daemons:
                await daemon.ready()
            ready_at = monotonic()
            for daemon in ends.daemons:
                await daemon.until_logged("relay_up", timeout_s=NEVER_S)
            reached_at = monotonic()
            async with asyncio.timeout(NEVER_S):
                await talking
        except TimeoutError:
            return Outcome()
        first_at = max(min(voice.received_at.values()) for voice in ends.talk.voices)
        direct_at = await until_direct(ends.daemons, direct_limit_s)
        (peer,) = (await ends.daemons[0].status())["peers"].values()
        await asyncio.sleep(TALK_S)
        end = monotonic()
        await ends.talk.back(end)
        return Outcome(
            max(0.0, first_at - ready_at),
            max(0.0, first_at - reached_at),
            None if direct_at is None else max(0.0, direct_at - reached_at),
            "" if direct_at is None else peer["path"],
            sum(len(voice.sent_between(first_at, end)) for voice in ends.talk.voices),
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


async def until_direct(daemons: Sequence[DaemonProcess], limit_s: float) -> float | None:
    """When all of them send along direct paths; None if they did not in time."""
    end = monotonic() + limit_s
    while monotonic() < end:
        if all([_is_direct(await daemon.status()) for daemon in daemons]):
            return monotonic()
        await asyncio.sleep(_POLL_S)
    return None


def _is_direct(status: Status) -> bool:
    (peer,) = status["peers"].values()
    return any(path["relay"] is None and "stream" in path["carries"] for path in peer["paths"])
