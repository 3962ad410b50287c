"""The bound on the age of a command, against a station whose system keeps packets while it has no keys.

Linux and wireguard-go keep up to 128 packets until the next keys, and send them first. The attacker decides about
every datagram: now, later, or never.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import suppress

import pytest

from tests.stations.client import Client
from tests.stations.world import World
from uavlinkd.stations.session import MOST_AGE_S

KEYS_S, RENEW_S, RETRY_S, TRIES_S, MOST_KEPT = 180.0, 120.0, 5.0, 90.0, 128


class KeepingClient(Client):
    """A client with the timers of the whitepaper, and a system that keeps packets for the next keys."""

    now: Callable[[], float]
    emit: Callable[[bytes], None]

    def switch_on(self) -> None:
        """Also if it was on before: keys and kept packets are gone."""
        self._send, self._kept = None, list[bytes]()
        self._receivers.clear()
        self._unconfirmed.clear()
        self._made_at = self.born_at = self._trying_since = self._initiated_at = -KEYS_S

    @property
    def has_keys(self) -> bool:
        """Whether a packet leaves at once."""
        return self._send is not None and self.now() - self.born_at < KEYS_S

    def data(self, packet: bytes) -> bytes:
        if not self.has_keys or self.now() - self.born_at > RENEW_S:
            self._initiate()
        if self.has_keys:
            return super().data(packet)
        self._kept = [*self._kept, packet][-MOST_KEPT:]
        return b""

    def _initiate(self) -> None:
        now = self.now()
        if now - self._initiated_at < RETRY_S:
            return
        if now - self._trying_since >= TRIES_S:
            self._trying_since = now
            self._kept.clear()
        self._initiated_at = self._made_at = now
        self.emit(self.initiation())

    def on_initiation(self, message: bytes) -> bytes:
        self._made_at = self.now()
        return super().on_initiation(message)

    def _use(self, send: bytes, index: int) -> None:
        super()._use(send, index)
        self.born_at = self._made_at
        kept, self._kept = self._kept, []
        for packet in kept:
            self.emit(super().data(packet))


class KeepingWorld(World):
    """Its station keeps packets, and makes new keys itself when they are due."""

    def __init__(self, seed: int, *, answers_pings: bool) -> None:
        super().__init__(seed)
        self.client.__class__ = KeepingClient
        assert isinstance(self.client, KeepingClient)
        self.keeping = self.client
        self.keeping.now, self.keeping.emit = lambda: self.now, self.from_client
        self.keeping.answers_pings = answers_pings
        self.keeping.switch_on()

    def from_client(self, datagram: bytes) -> None:
        if datagram:
            super().from_client(datagram)

    def _at_client(self, datagram: bytes) -> None:
        with suppress(AssertionError, KeyError):  # it was switched off meanwhile, or has newer keys
            super()._at_client(datagram)


def oldest(world: World) -> float:
    return max(world.ages, default=0.0)


@pytest.mark.parametrize("answers", [True, False])
def test_keys_that_the_station_never_used_are_no_evidence(*, answers: bool) -> None:
    """The attacker lets one handshake pass without data: the daemon alone uses it. 60 s later another one passes.

    The station had no keys in between, and its system kept a command.
    """
    world = KeepingWorld(1, answers_pings=answers)
    world.command(b"0")
    world.run(world.now + 1.0)
    born_at = world.keeping.born_at
    world.to_client = lambda datagram: None
    world.run(born_at + 170.0)
    world.to_client = lambda datagram: 0.02 if datagram[0] == 1 and world.now < born_at + 177.0 else None
    world.commands(9.0)
    world.run(born_at + KEYS_S + 1.0)
    world.delivered.clear()
    world.to_daemon = lambda datagram: 0.02 if datagram[0] != 1 else None  # it makes no keys itself
    world.command(repr(world.now).encode())
    assert not world.keeping.has_keys
    world.run(world.now + 60.0)
    world.to_client = lambda datagram: 0.02
    world.commands(10.0)
    assert len(world.delivered) > 10
    assert oldest(world) <= MOST_AGE_S


@pytest.mark.long
@pytest.mark.parametrize("answers", [True, False])
@pytest.mark.parametrize("seed", range(12))
def test_no_schedule_of_an_attacker_makes_a_command_older(seed: int, *, answers: bool) -> None:
    """It changes its mind about each kind of datagram in each direction, again and again, for twenty minutes."""
    world, chance = KeepingWorld(seed, answers_pings=answers), random.Random(seed)
    decisions: dict[tuple[str, int], float | None] = {}

    def decide(way: str) -> Callable[[bytes], float | None]:
        return lambda datagram: decisions.get((way, datagram[0]), 0.02)

    world.to_daemon, world.to_client = decide("in"), decide("out")
    for _ in range(80):
        if chance.random() < 0.3:
            decisions.clear()
        for way in ("in", "out"):
            for kind in (1, 2, 4):
                if chance.random() < 0.4:
                    decisions[way, kind] = chance.choice((None, None, 0.02, 1.0, 4.0, 30.0))
        if chance.random() < 0.1:
            world.keeping.switch_on()
        seconds = chance.choice((0.2, 1.0, 3.0, 10.0, 60.0))
        if chance.random() < 0.7:
            world.commands(seconds)
        else:
            world.run(world.now + seconds)
        assert len(world.indices) <= 4
    decisions.clear()
    world.commands(20.0)
    assert oldest(world) <= MOST_AGE_S
    assert world.ages[-1] < 0.1  # commands pass again
