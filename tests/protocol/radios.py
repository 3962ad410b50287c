"""Two nodes and several radios between them, in simulated time: each radio has a delay, may lose, and may die."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from tests.protocol.harness import FRAME, Pair, Side, of
from uavlinkd.protocol import wire
from uavlinkd.protocol.outputs import Deliver, Output, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.settings import Class, Link, Redundancy, Timers
from uavlinkd.protocol.suites import X25519

ENVELOPES = (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE)


def at_a(radio: int) -> Path:
    """Alpha's address on a radio."""
    return Path(radio, (f"10.{radio}.0.1", 5790))


def at_b(radio: int) -> Path:
    """Bravo's address on a radio."""
    return Path(radio, (f"10.{radio}.0.2", 5790))


def link(redundancy: Redundancy = Redundancy.CRITICAL, idle_probe_s: float = 15.0, **timers: float) -> Link:
    """A link with the ordinary timers but for these."""
    durations = replace(Timers(), **timers)
    return Link(suites=(X25519,), redundancy=redundancy, idle_probe_s=idle_probe_s, timers=durations)


@dataclass
class Radio:
    """The path through one radio: what is sent arrives later, in both directions."""

    delay_s: float
    is_dead: bool = False
    loses: Callable[[bytes], bool] = lambda datagram: False
    """Whether it loses this datagram."""


class Sent(NamedTuple):
    """A datagram that a side sent."""

    at: float
    side: Side
    datagram: bytes
    path: Path


class Seen(NamedTuple):
    """Something that a side's core put out, other than datagrams."""

    at: float
    side: Side
    output: Output


@dataclass
class Radios:
    """Alpha has a configured path to bravo along each radio; bravo learns its own, or has them configured too."""

    delays_s: tuple[float, ...] = (0.02, 0.05)
    link_a: Link = field(default_factory=link)
    link_b: Link = field(default_factory=link)
    both_configured: bool = False
    now: float = 0.0
    sent: list[Sent] = field(default_factory=list)
    seen: list[Seen] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.radios = [Radio(delay_s) for delay_s in self.delays_s]
        self.pair = Pair(self.link_a, self.link_b)
        self.a, self.b = self.pair.a, self.pair.b
        self._queue: list[tuple[float, int, Side, bytes, Path]] = []
        numbers = range(len(self.radios))
        self.a.node.set_paths(self.a.peer, [at_b(number) for number in numbers], self.now)
        if self.both_configured:
            self.b.node.set_paths(self.b.peer, [at_a(number) for number in numbers], self.now)

    def run(self, seconds: float, each_s: float = 0.0, *senders: Callable[[], object]) -> Radios:
        """Let time pass; each so often the senders are called."""
        end, next_at = self.now + seconds, self.now
        for _ in range(100_000):
            moments = [end, self.a.node.next_deadline(), self.b.node.next_deadline()]
            if senders:
                moments.append(next_at)
            if self._queue:
                moments.append(self._queue[0][0])
            self.now = max(self.now, min(moments))
            if senders and self.now >= next_at:
                next_at += each_s
                for sender in senders:
                    sender()
            while self._queue and self._queue[0][0] <= self.now:
                _, _, side, datagram, source = heapq.heappop(self._queue)
                self.act(side, side.node.receive(datagram, source, self.now))
            for side in (self.a, self.b):
                self.act(side, side.timeout(self.now))
            if self.now >= end:
                return self
        raise AssertionError("the timers run in a circle")

    def act(self, side: Side, outputs: Iterable[Output]) -> None:
        """Send what a side transmits, and note the rest."""
        for out in outputs:
            if not isinstance(out, Transmit):
                self.seen.append(Seen(self.now, side, out))
                continue
            self.sent.append(Sent(self.now, side, out.datagram, out.path))
            radio = self.radios[out.path.socket]
            here, there = (at_a, at_b) if side is self.a else (at_b, at_a)
            if out.path != there(out.path.socket) or radio.is_dead or radio.loses(out.datagram):
                continue
            other = self.b if side is self.a else self.a
            arrival = self.now + radio.delay_s
            heapq.heappush(self._queue, (arrival, len(self.sent), other, out.datagram, here(out.path.socket)))

    def send(self, side: Side, cls: Class = Class.STREAM, *frames: bytes) -> None:
        """Send frames (one by default) of a class."""
        self.act(side, side.node.send(side.peer, frames or (FRAME,), self.now, cls))

    def measure_lengths(self) -> Radios:
        """Each side sends frames together, and tests how long envelopes may be."""
        for side in (self.a, self.b):
            self.send(side, Class.STREAM, FRAME, FRAME)
        return self.run(1.0)

    def sender(self, side: Side, cls: Class = Class.STREAM) -> Callable[[], None]:
        """For :meth:`run`: one frame at a time."""
        return lambda: self.send(side, cls)

    def state(self, side: Side, radio: int) -> PathState:
        """What a side knows of the path along a radio."""
        state = side.peer.paths.find((at_b if side is self.a else at_a)(radio))
        assert state is not None
        return state

    def envelopes(self, side: Side, since: float) -> list[Sent]:
        """The envelopes that a side sent from a moment on."""
        return [
            sent for sent in self.sent if sent.side is side and sent.at >= since and sent.datagram[0] in ENVELOPES
        ]

    def questions(self, side: Side, radio: int, since: float) -> list[float]:
        """When a side asked along a radio. Only its own probes are counted, not its answers."""
        return [
            sent.at
            for sent in self.envelopes(side, since)
            if sent.path.socket == radio and _is_question(side, sent.datagram)
        ]

    def events(self, side: Side, kind: type, since: float = 0.0) -> list[tuple[float, Output]]:
        """The events of a kind that a side reported, and when."""
        return [(at, out) for at, other, out in self.seen if other is side and at >= since and isinstance(out, kind)]

    def delivered(self, side: Side, since: float = 0.0) -> list[Deliver]:
        """What a side delivered."""
        return of((seen.output for seen in self.seen if seen.side is side and seen.at >= since), Deliver)


def _is_question(side: Side, datagram: bytes) -> bool:
    """Whether an authenticated envelope begins with a probe that asks. A padded one tests a path's limit instead."""
    payload = datagram[wire.SHORT_HEADER_BYTES : -side.session.tag_bytes]
    return payload[:1] == b"\3" and payload[1] != 2 and payload[2:6] != bytes(4)
