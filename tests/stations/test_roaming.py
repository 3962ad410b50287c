"""Rekeys without end in virtual time, on a bad network, while the station moves and both ends restart.

``python -m tests.stations.test_roaming 100000`` prints the figures of so many.
"""

from __future__ import annotations

import sys
from functools import partial
from itertools import pairwise

import pytest

from tests.stations.world import THERE, World

REKEY_EVERY_S = 1.0
FRAME_EVERY_S = 0.25
DEAD_S = 15.0
"""A station that sent something and received nothing for so long initiates (whitepaper, section 6.5)."""
AGAIN_S = 5.0
"""Between two initiations without a response (section 6.1)."""
LOST = 0.01
REPEATED = 0.01
RESTART = 0.01
"""The chance of a restart of one end at a rekey."""


class Roamer:
    """A station that never rests. Its system initiates as the whitepaper says, and by itself at short timers."""

    def __init__(self, seed: int = 1, lost: float = LOST) -> None:
        self.world = world = World(seed)
        self.random = world.random
        self.lost = lost
        self.sent = self.rekeys = self.moves = self.restarts = 0
        self.received_at = self.initiated_at = world.now
        world.to_daemon = self._to_daemon
        world.to_client = self._to_client

    def _to_daemon(self, datagram: bytes) -> float | None:
        if self.random.random() < REPEATED:
            self.world.at(self.world.now + self.random.uniform(0.0, 3.0), partial(self.world.receive, datagram))
        return self._delay_s()

    def _to_client(self, datagram: bytes) -> float | None:
        delay_s = self._delay_s()
        if delay_s is not None and datagram[0] in (2, 4):
            self.received_at = self.world.now
        return delay_s

    def _delay_s(self) -> float | None:
        return None if self.random.random() < self.lost else self.random.uniform(0.005, 0.06)

    def initiate(self) -> None:
        """The station's system initiates."""
        self.initiated_at = self.world.now
        self.world.from_client(self.world.client.initiation())

    def live(self, seconds: float) -> None:
        """Send numbered frames for so long."""
        world = self.world
        for _ in range(int(seconds / FRAME_EVERY_S)):
            if world.client.is_open:
                world.from_client(world.client.udp(b"%d" % self.sent))
                self.sent += 1
            is_dead = world.now - self.received_at > DEAD_S or not world.client.is_open
            if is_dead and world.now - self.initiated_at >= AGAIN_S:
                self.initiate()
            world.run(world.now + FRAME_EVERY_S)

    def rekey(self) -> None:
        """One of the ends makes new keys; at each tenth the station moves first, and at some one end restarts."""
        world = self.world
        self.rekeys += 1
        if self.rekeys % 10 == 0:
            self.moves += 1
            world.there = THERE[0], 1024 + self.rekeys % 60_000
        if self.random.random() < RESTART:
            self.restarts += 1
            if self.random.random() < 0.5:
                world.restart_daemon()
            else:
                world.client.restart()
                self.initiate()
        elif self.random.random() < 0.5:
            world.from_daemon(world.tunnel.initiate(world.now))
        else:
            self.initiate()
        self.live(REKEY_EVERY_S)

    @property
    def longest_gap_s(self) -> float:
        """The longest time without a frame at the daemon."""
        times = [at for _, _, at in self.world.delivered]
        return max(after - before for before, after in pairwise(times))


def roamed(rekeys: int) -> Roamer:
    roamer = Roamer()
    roamer.initiate()
    roamer.live(1.0)
    for _ in range(rekeys):
        roamer.rekey()
    roamer.live(60.0)
    return roamer


@pytest.mark.long
def test_no_session_is_lost_and_no_frame_comes_twice() -> None:
    """No gap is longer than two initiations without a response after the station's system noticed."""
    roamer = roamed(2000)
    payloads = [payload for payload, _, _ in roamer.world.delivered]
    assert len(set(payloads)) == len(payloads)
    assert roamer.longest_gap_s < DEAD_S + 2 * AGAIN_S + 1
    assert roamer.world.delivered[-1][2] > roamer.world.now - 1.0
    assert len(roamer.world.indices) <= 4


def test_station_is_back_soon_after_each_restart_of_the_daemon() -> None:
    """A second after its next packet, on a network that loses nothing."""
    roamer = Roamer(lost=0.0)
    roamer.initiate()
    roamer.live(2.0)
    for _ in range(50):
        restarted_at = roamer.world.now
        roamer.world.restart_daemon()
        roamer.live(5.0)
        back_at = next(at for _, _, at in roamer.world.delivered if at > restarted_at)
        assert back_at - restarted_at <= 1.0


if __name__ == "__main__":
    done = roamed(int(sys.argv[1]))
    arrived = [payload for payload, _, _ in done.world.delivered]
    twice = len(arrived) - len(set(arrived))
    print(
        f"{done.rekeys:,} rekeys, {done.moves:,} moves, {done.restarts:,} restarts, {done.sent:,} frames sent,"
        f" {len(arrived):,} delivered, {twice} twice, longest gap {done.longest_gap_s:.1f} s"
    )
