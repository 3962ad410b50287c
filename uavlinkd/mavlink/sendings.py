"""Equal bytes that arrive again: a new sending, a copy by another route, or a return from a circle.

The rule, its reasons and its limits are in the specification (`uavlinkd/protocol/README.md`, section 19).
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from uavlinkd.mavlink.dialect import Lane
from uavlinkd.mavlink.frames import Frame

ROUTES_DIFFER_S: Final = 1.0
"""By how much the delays of two routes differ at most."""
REMEMBERED_S: Final = 5.0
"""A frame is remembered for this time at least, and up to twice that, unless too many arrive."""
CIRCLE_S: Final = 60.0
"""A circle is remembered for this time after the last return."""
REPEATED_S: Final = 0.1
"""Repetitions of one broadcast that could be returns are sent on so far apart at least."""
SEQUENCE: Final = 256
"""After so many frames a sender may have the same sequence number again."""
MAX_FRAMES_REMEMBERED: Final = 4096  # in each half of the memory


@dataclass(slots=True)
class Circle:
    """What returned from one port."""

    through: set[Any]
    """The ports that all of it was sent to. The port itself is one of them if it may return what it gets."""
    returned_at: float
    systems: set[int] = field(default_factory=set)
    """The senders of what came from other ports. A second route of one system brings frames of that system only."""
    is_suspected: bool = False
    """Whether a command returned, or a broadcast of the port itself."""


@dataclass(slots=True)
class _Sending:
    """The last sending of a frame that arrived more than once."""

    source: Any
    at: float
    ports: Collection[Any]
    number: int
    """How many frames had arrived until then."""
    arrivals: dict[Hashable, int]
    """By route, while sendings follow one another within :data:`ROUTES_DIFFER_S`."""
    arrived_at: float
    return_s: float | None = None
    """After what time it returned to its own port."""
    is_repeated: bool = False
    """Whether its sender repeats it."""


class Sendings:
    """The frames of the last seconds, and the circles that they showed. All times are monotonic seconds."""

    def __init__(self, routes: Mapping[Any, Hashable], received_at: Mapping[Any, Collection[object]]) -> None:
        """``routes``: of each port; a peer is its own route. ``received_at``: the addresses behind each port."""
        self.circles: dict[Any, Circle] = {}
        """By the port from which frames return."""
        self.dropped = 0
        """Copies and returns."""
        self._routes, self._received_at = routes, received_at
        self.seen: dict[bytes, Any] = {}
        """By the bytes of a frame: source, time, ports and number, or a `_Sending` if it arrived again. The path of a
        frame adds what is not here, without a call of :meth:`is_new`."""
        self.seen_before: dict[bytes, Any] = {}
        """Frames of the previous half, as in :attr:`seen`."""
        self.half_ends_at = float("-inf")
        """When a half of the memory is over."""
        self.count = 0
        """How many frames arrived."""

    def is_new(self, frame: Frame, source: Hashable, ports: Collection[Hashable], now: float) -> bool:
        """Whether a frame is a new sending, which goes to these ports. Remembers it; counts copies and returns."""
        raw = frame.raw
        if now >= self.half_ends_at or len(self.seen) >= MAX_FRAMES_REMEMBERED:
            self._turn(now)
        self.count += 1
        known = self.seen.get(raw) or self.seen_before.get(raw)
        if known is None:
            self.seen[raw] = source, now, ports, self.count
            return True
        if type(known) is tuple:
            first, at, sent_to, number = known
            known = _Sending(first, at, sent_to, number, {self._routes.get(first): 1}, at)
            (self.seen if raw in self.seen else self.seen_before)[raw] = known
        quiet_s, known.arrived_at = now - known.arrived_at, now
        if self._is_return(frame, known, source, quiet_s, now) or self._is_copy(frame, known, source, now):
            self.dropped += 1
            return False
        route, arrivals = self._routes[source], known.arrivals if now - known.at < ROUTES_DIFFER_S else {}
        known.arrivals = {**arrivals, route: arrivals.get(route, 0) + 1}
        known.source, known.at, known.ports, known.number, known.return_s = source, now, ports, self.count, None
        self.seen[raw] = known
        return True

    def note_own(self, raw: bytes, ports: Collection[Hashable], now: float) -> None:
        """The daemon itself sent these bytes to clients: if a client returns them, they go nowhere."""
        if now >= self.half_ends_at:
            self._turn(now)
        self.seen[raw] = None, now, ports, self.count

    def forget(self, raw: bytes) -> None:
        """These bytes were not delivered: the same bytes are new again."""
        self.seen.pop(raw, None)
        self.seen_before.pop(raw, None)

    def _turn(self, now: float) -> None:
        """Forget the older half of the frames, and circles that have ended."""
        self.seen_before = {} if now >= self.half_ends_at + REMEMBERED_S else self.seen
        self.seen = {}
        self.half_ends_at = now + REMEMBERED_S
        self.circles = {port: one for port, one in self.circles.items() if now - one.returned_at < CIRCLE_S}

    def _is_peer(self, port: Hashable) -> bool:
        return self._routes.get(port) is port

    def _is_copy(self, frame: Frame, known: _Sending, source: Hashable, now: float) -> bool:
        """Whether the route brings a sending that another route brought already."""
        arrived = known.arrivals.get(self._routes[source], 0)
        if now - known.at >= ROUTES_DIFFER_S or arrived >= max(known.arrivals.values()):
            return False
        if _is_order(frame) and not (self._is_peer(source) and self._is_peer(known.source)):
            return False
        known.arrivals[self._routes[source]] = arrived + 1
        return True

    def _is_return(self, frame: Frame, known: _Sending, source: Hashable, quiet_s: float, now: float) -> bool:
        """Whether this daemon's own sending of the frame comes back. ``quiet_s``: since equal bytes arrived last."""
        sender = frame.header.system, frame.header.component
        circle = self.circles.get(source)
        is_proven = circle is not None and bool(circle.systems) and not circle.through.isdisjoint(known.ports)
        if source != known.source:
            if not is_proven and (source not in known.ports or sender in self._received_at[source]):
                return False
            self._note(source, known.ports, now, is_suspected=_is_order(frame))
            self.circles[source].systems.add(sender[0])
            return True
        through = [
            port
            for port in known.ports
            if not self._is_peer(port) and (not self._is_peer(source) or sender in self._received_at.get(port, ()))
        ]
        is_apart = now - known.at >= REPEATED_S  # a circle with several returns of each sending cannot swell
        may_return = through and not (known.is_repeated and is_apart) and frame.header.target_system == 0
        if self.count - known.number >= SEQUENCE or not (may_return or is_proven):
            return False
        if known.return_s is None:
            known.return_s = now - known.at
            self._note(source, through or known.ports, now, is_suspected=True)
        elif is_apart and quiet_s >= 4 * known.return_s:  # a return would have come earlier
            return False
        elif quiet_s >= known.return_s / 2 and is_apart and not is_proven:  # nothing was sent that could return
            known.is_repeated = True
            self.circles.pop(source, None)
            return False
        return True

    def _note(self, source: Hashable, ports: Collection[Hashable], now: float, *, is_suspected: bool) -> None:
        circle = self.circles.setdefault(source, Circle(set(ports), now))
        circle.through, circle.returned_at = circle.through.intersection(ports) or set(ports), now
        circle.is_suspected |= is_suspected


def _is_order(frame: Frame) -> bool:
    """Whether it is a command, an answer to one, or manual control, for a target."""
    return frame.header.target_system != 0 and frame.header.kind.lane is Lane.URGENT
