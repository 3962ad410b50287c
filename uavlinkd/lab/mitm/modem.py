"""Two telemetry modems and the air between them: bytes and ``now`` in, bytes when they are due out.

No I/O and no clock; seeded. Each *end* is a modem on a serial line with a host. The stages of a byte are: the kernel
of the host, the line to the modem (10 bits per byte), the modem's queue, the air, the line from the other modem.

- *The queue is not reported.* Bytes that do not fit are lost, as in a SiK.
- *The air is half duplex.* One modem sends at a time, and a change of the sender takes ``turn_around_s``.
- *Air packets.* A modem sends up to ``packet_bytes`` together. They arrive together, or are lost together. The
  boundaries have no relation to those of the host's datagrams.
- *The line from a modem* alters and loses bytes at random. Random draws are made for these only.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from random import Random
from typing import Final, NamedTuple

BITS_PER_BYTE: Final = 10
"""On the line, with start and stop bit."""
HELD_BYTES: Final = 1 << 20
"""Most bytes that a modem holds back. More are lost. It bounds memory and does not model a modem."""
_ROUNDING: Final = 1e-6
"""Part of a byte's time by which floating-point times may differ."""


class ModemEnd(StrEnum):
    """One of the two modems, and its host."""

    LEFT = "left"
    RIGHT = "right"

    @property
    def other(self) -> ModemEnd:
        return ModemEnd.RIGHT if self is ModemEnd.LEFT else ModemEnd.LEFT


@dataclass(frozen=True, slots=True)
class ModemSettings:
    """Both modems and the air. The defaults are a SiK radio at 57,600 baud. Shares are 0 to 1.

    Raises:
        ValueError: a value is out of range.
    """

    air_bits_s: float = 24_000.0
    """What the air carries of the hosts' bytes, in both directions together."""
    line_baud: float = 57_600.0
    turn_around_s: float = 0.01
    """The air is silent for this time before the other modem sends."""
    turn_s: float = 0.1
    """A modem begins no packet later than this in its turn while the other one waits."""
    gather_s: float = 0.005
    """A modem waits so long for more bytes before it sends less than a whole packet."""
    queue_bytes: int = 2048
    packet_bytes: int = 240
    host_bytes: int = 4096
    """The host's kernel holds this for the line. It accepts no more."""
    chunk_bytes: int = 62
    """The host gets at most so many bytes at once, as from a USB adapter."""
    packet_loss: float = 0.0
    """Share of air packets that are lost."""
    byte_error_rate: float = 0.0
    """Share of bytes that the line from a modem alters."""
    byte_loss_rate: float = 0.0
    """Share of bytes that the line from a modem loses."""

    def __post_init__(self) -> None:
        for name in ("packet_loss", "byte_error_rate", "byte_loss_rate"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be a share from 0 to 1, not {getattr(self, name)}")
        for name in ("air_bits_s", "line_baud", "turn_s"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be more than 0, not {getattr(self, name)}")
        for name in ("turn_around_s", "gather_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be 0 or more, not {getattr(self, name)}")
        for name in ("queue_bytes", "packet_bytes", "host_bytes", "chunk_bytes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")


class Fate(StrEnum):
    """What happened to bytes that the host of an end wrote, or that come out at an end."""

    WRITTEN = "written"
    """By the host of this end, accepted by its kernel."""
    QUEUE_FULL = "queue_full"
    """Lost at the queue of this end."""
    UNPLUGGED = "unplugged"
    """Lost at this end because its modem was not plugged in."""
    ON_AIR = "on_air"
    PACKET_LOST = "packet_lost"
    """Sent by this end's modem, in packets that were lost."""
    ALTERED = "altered"
    """On the line to this end's host."""
    LOST_ON_LINE = "lost_on_line"
    """On the line to this end's host."""
    HELD = "held"
    INJECTED = "injected"
    """On the line to this end's host."""
    DELIVERED = "delivered"


class Transmission(NamedTuple):
    """An air packet."""

    sender: ModemEnd
    begin_at: float
    end_at: float
    data: bytes
    """Empty if the modem was pulled out meanwhile."""


@dataclass(slots=True)
class _Modem:
    """A modem with its line."""

    host: deque[int] = field(default_factory=deque)
    """Bytes that the host's kernel holds."""
    next_at: float = 0.0
    """When the first of them has crossed the line."""
    queue: bytearray = field(default_factory=bytearray)
    oldest_at: float = 0.0
    """When the first byte of the queue came; -inf if it has waited for a packet before."""
    is_plugged: bool = True
    hold_until: float = -math.inf
    held: bytearray = field(default_factory=bytearray)
    out: deque[tuple[float, bytes]] = field(default_factory=deque)
    """Chunks on the line to the host, and when they have crossed it."""
    out_free_at: float = 0.0


class ModemLink:
    """Two modems, their lines and the air.

    Args:
        settings: may be replaced at any time by the attribute; bytes on the line or on air keep their time.
        rng: the random source. An equal generator and equal calls return equal results.
        watch: gets each air packet at its end.
    """

    def __init__(
        self, settings: ModemSettings, rng: Random, watch: Callable[[Transmission], object] | None = None
    ) -> None:
        self.settings = settings
        self.bytes: dict[ModemEnd, Counter[Fate]] = {end: Counter() for end in ModemEnd}
        """The number of bytes, by end and fate."""
        self.packets: Counter[ModemEnd] = Counter()
        self._rng = rng
        self._watch = watch
        self._modems = {end: _Modem() for end in ModemEnd}
        self._holder = ModemEnd.LEFT  # whose turn it is
        self._turn_began_at = -math.inf
        self._on_air: Transmission | None = None
        self._air_free_at = -math.inf
        self._out: list[tuple[ModemEnd, bytes]] = []

    # The hosts. ``now`` must not decrease from call to call.

    def write(self, end: ModemEnd, data: bytes, now: float) -> int:
        """The host of an end writes. Returns how many bytes its kernel accepted.

        Bytes that are written to a modem that is not plugged in are accepted and lost.
        """
        self._run(now)
        modem = self._modems[end]
        if not modem.is_plugged:
            self.bytes[end][Fate.UNPLUGGED] += len(data)
            return len(data)
        accepted = data[: self.settings.host_bytes - len(modem.host)]
        if accepted and not modem.host:
            modem.next_at = max(modem.next_at, now) + self._byte_s
        modem.host.extend(accepted)
        self.bytes[end][Fate.WRITTEN] += len(accepted)
        return len(accepted)

    def unwritten(self, end: ModemEnd, now: float) -> int:
        """The bytes that the kernel of a host holds, as TIOCOUTQ counts them."""
        self._run(now)
        return len(self._modems[end].host)

    def queued(self, end: ModemEnd, now: float) -> int:
        """The bytes in the queue of a modem, which no host can see."""
        self._run(now)
        return len(self._modems[end].queue)

    def next_deadline(self) -> float:
        """The time of the next call of :meth:`advance`; infinity for never."""
        return -math.inf if self._out else self._next_event()

    def advance(self, now: float) -> list[tuple[ModemEnd, bytes]]:
        """Pop what came out at the hosts by ``now``: ends and bytes, in order."""
        self._run(now)
        out, self._out = self._out, []
        return out

    # What happens to modems and lines.

    def pull(self, end: ModemEnd, now: float) -> None:
        """Pull a modem out: it loses its power, and all that it and its line hold."""
        self._run(now)
        old = self._modems[end]
        lost = len(old.host) + len(old.queue) + len(old.held) + sum(len(chunk) for _, chunk in old.out)
        if self._on_air is not None and self._on_air.sender is end:
            lost += len(self._on_air.data)
            self._on_air = self._on_air._replace(data=b"")
        self.bytes[end][Fate.UNPLUGGED] += lost
        self._modems[end] = _Modem(is_plugged=False)

    def plug(self, end: ModemEnd, now: float) -> None:
        """Put a modem back. It works at once."""
        self._run(now)
        self._modems[end].is_plugged = True

    def is_plugged(self, end: ModemEnd) -> bool:
        return self._modems[end].is_plugged

    def hold(self, end: ModemEnd, until: float, now: float) -> None:
        """Hold back what is for the host of an end until a time, or until :meth:`release`. Nothing is lost."""
        self._run(now)
        self._modems[end].hold_until = until

    def release(self, end: ModemEnd, now: float) -> None:
        """Let the modem write what it held back, at the rate of its line."""
        self._run(now)
        self._release(end, now)

    def inject(self, end: ModemEnd, data: bytes, now: float) -> None:
        """Put bytes on the line to the host of an end, after those that are on it."""
        self._run(now)
        self.bytes[end][Fate.INJECTED] += len(data)
        self._put_on_line(end, data, now)

    # Events, in the order of time.

    @property
    def _byte_s(self) -> float:
        return BITS_PER_BYTE / self.settings.line_baud

    def _run(self, now: float) -> None:
        while (at := self._next_event()) <= now:
            self._step(at)
        for end in ModemEnd:
            self._receive_from_host(end, now)

    def _next_event(self) -> float:
        moments = [self._next_on_air()]
        for modem in self._modems.values():
            if modem.out:
                moments.append(modem.out[0][0])
            if modem.held:
                moments.append(modem.hold_until)
        return min(moments)

    def _next_on_air(self) -> float:
        if self._on_air is not None:
            return self._on_air.end_at
        return max(self._air_free_at, min(map(self._ready_at, ModemEnd)))

    def _step(self, at: float) -> None:
        for end, modem in self._modems.items():
            while modem.out and modem.out[0][0] <= at:
                chunk = modem.out.popleft()[1]
                self.bytes[end][Fate.DELIVERED] += len(chunk)
                self._out.append((end, chunk))
            if modem.held and modem.hold_until <= at:
                self._release(end, at)
        if self._next_on_air() <= at:
            for end in ModemEnd:
                self._receive_from_host(end, at)
            if self._on_air is not None:
                self._end_packet(self._on_air)
            else:
                self._use_air(at)

    def _receive_from_host(self, end: ModemEnd, at: float) -> None:
        """Move the bytes that have crossed the line into the queue."""
        modem, settings = self._modems[end], self.settings
        if not modem.host or modem.next_at > at:
            return
        arrived = min(len(modem.host), 1 + int((at - modem.next_at) / self._byte_s + _ROUNDING))
        room = settings.queue_bytes - len(modem.queue)
        if not modem.queue:
            modem.oldest_at = modem.next_at
        taken = bytes(modem.host.popleft() for _ in range(arrived))
        modem.next_at += arrived * self._byte_s
        modem.queue += taken[:room]
        self.bytes[end][Fate.QUEUE_FULL] += len(taken[room:])

    def _ready_at(self, end: ModemEnd) -> float:
        """When a modem has a packet to send: a whole one, or the oldest byte has waited long enough."""
        modem, settings = self._modems[end], self.settings
        whole = min(settings.packet_bytes, settings.queue_bytes)
        missing = whole - len(modem.queue)
        if missing <= 0:
            return -math.inf
        at = math.inf
        if missing <= len(modem.host):
            at = modem.next_at + (missing - 1) * self._byte_s
        if modem.queue:
            return min(at, modem.oldest_at + settings.gather_s)
        return min(at, modem.next_at + settings.gather_s) if modem.host else at

    def _use_air(self, at: float) -> None:
        """The air is free, and at least one modem is ready: begin a packet, or the turn of the other modem."""
        is_ready = {end: self._ready_at(end) <= at for end in ModemEnd}
        other = self._holder.other
        if is_ready[other] and (not is_ready[self._holder] or at - self._turn_began_at >= self.settings.turn_s):
            self._holder = other
            self._turn_began_at = self._air_free_at = at + self.settings.turn_around_s
        else:
            self._begin_packet(self._holder, at)

    def _begin_packet(self, sender: ModemEnd, at: float) -> None:
        modem, settings = self._modems[sender], self.settings
        size = min(len(modem.queue), settings.packet_bytes)
        data = bytes(modem.queue[:size])
        del modem.queue[:size]
        modem.oldest_at = -math.inf
        duration_s = 8 * size / settings.air_bits_s
        self._on_air = Transmission(sender, at, at + duration_s, data)
        self.packets[sender] += 1
        self.bytes[sender][Fate.ON_AIR] += size

    def _end_packet(self, packet: Transmission) -> None:
        self._on_air, self._air_free_at = None, packet.end_at
        if self._watch is not None:
            self._watch(packet)
        receiver, settings = packet.sender.other, self.settings
        if settings.packet_loss and self._rng.random() < settings.packet_loss:
            self.bytes[packet.sender][Fate.PACKET_LOST] += len(packet.data)
            return
        modem = self._modems[receiver]
        if packet.end_at < modem.hold_until:
            kept = packet.data[: HELD_BYTES - len(modem.held)]
            modem.held += kept
            self.bytes[receiver][Fate.HELD] += len(kept)
            return
        self._put_on_line(receiver, packet.data, packet.end_at)

    def _release(self, end: ModemEnd, at: float) -> None:
        modem = self._modems[end]
        held, modem.held, modem.hold_until = bytes(modem.held), bytearray(), -math.inf
        self._put_on_line(end, held, at)

    def _put_on_line(self, end: ModemEnd, data: bytes, at: float) -> None:
        modem = self._modems[end]
        if not modem.is_plugged:
            self.bytes[end][Fate.UNPLUGGED] += len(data)
            return
        crossing_at = max(modem.out_free_at, at)
        size = self.settings.chunk_bytes
        for begin in range(0, len(data), size):
            chunk = data[begin : begin + size]
            crossing_at += len(chunk) * self._byte_s
            if damaged := self._damaged(end, chunk):
                modem.out.append((crossing_at, damaged))
        modem.out_free_at = crossing_at

    def _damaged(self, end: ModemEnd, data: bytes) -> bytes:
        """The bytes with the random errors of a line."""
        loss, errors = self.settings.byte_loss_rate, self.settings.byte_error_rate
        if loss:
            kept = bytes(byte for byte in data if self._rng.random() >= loss)
            self.bytes[end][Fate.LOST_ON_LINE] += len(data) - len(kept)
            data = kept
        if errors:
            changes = bytes(self._rng.randrange(1, 256) if self._rng.random() < errors else 0 for _ in data)
            self.bytes[end][Fate.ALTERED] += len(changes) - changes.count(0)
            data = bytes(byte ^ change for byte, change in zip(data, changes, strict=True))
        return data
