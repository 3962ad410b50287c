"""Where a frame goes: to the ports behind which its target was heard.

A *port* is one local client or one peer, named by any hashable value. The rules are MAVLink's
(https://mavlink.io/en/guide/routing.html), as mavlink-router and ArduPilot keep them:

* A frame without a target, with target 0, or of a message that cannot be read goes to all other ports.
* A frame for a component goes to the ports where that component was heard. If it was not heard anywhere, or the
  frame is for all of a system's components, it goes to the ports where the system was heard.
* Nothing goes back to the port that it came from.
* A frame whose target was heard nowhere else, or behind its own port alone, goes to all other ports, as a network
  switch does with an address that it has not learnt: a link must carry the first word to a system that is silent
  until it is asked, and a port that mirrors both sides of a conversation. mavlink-router drops such frames;
  ``floods_unknown=False`` does too.

Two more keep a mesh of daemons from multiplying frames:

* What comes from a peer goes to local ports only, unless this daemon relays.
* A frame that came lately from another port is a duplicate, and dropped. From the same port it is a sender's own
  repetition, and passes.

All ports where an address was heard get its frames. So whoever claims a system's id gains a copy of what is sent to
it, and takes nothing from the real one; but who may claim another's system can say a frame before that other does,
and the real one is then the duplicate. Which ids a port may claim is for the policy to say. Only frames that passed
the policy may be given to `Router.route`: it learns from them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from enum import StrEnum
from typing import Final, Generic, TypeVar

from uavlinkd.mavlink.frames import Frame, Header

# MAVLink's components send a HEARTBEAT a second; satellite links report every few, to a minute.
ROUTE_LIFETIME_S: Final = 120.0
LIFETIME_PARTS: Final = 8  # what is heard, and what is silent, is noted this often in a lifetime
# Longer than two ways differ in delay, shorter than a sender with the same bytes again behind another port.
DUPLICATE_WINDOW_S: Final = 1.0  # at least; up to twice that

MAX_ADDRESSES_PER_PORT: Final = 512  # systems and components heard behind one port
MAX_FRAMES_REMEMBERED: Final = 4096  # in each half of the window
MAX_DECISIONS: Final = 4096

Address = tuple[int, int]  # system, component
P = TypeVar("P", bound=Hashable)


class Unrouted(StrEnum):
    """Why a frame goes nowhere."""

    DUPLICATE = "duplicate"  # came by another way already
    UNKNOWN_TARGET = "unknown_target"  # its target was not heard, or not lately
    NO_OTHER_PORT = "no_other_port"  # its target is behind the port that it came from, or there is nobody else


class Router(Generic[P]):
    """Learns who is behind which port, and says where frames go. All times in seconds, monotonic."""

    def __init__(
        self,
        *,
        relays: bool = False,
        floods_unknown: bool = True,
        route_lifetime_s: float = ROUTE_LIFETIME_S,
        duplicate_window_s: float = DUPLICATE_WINDOW_S,
    ) -> None:
        self.unrouted: Counter[Unrouted] = Counter()
        self._relays = relays
        self._floods_unknown = floods_unknown
        self._lifetime_s = route_lifetime_s
        self._window_s = duplicate_window_s
        self._is_peer: dict[P, bool] = {}  # every port, in the order in which they came
        self._heard_at: dict[P, dict[Address, float]] = {}  # by port: when each address was heard last
        self._ports_of: dict[int, dict[int, set[P]]] = {}  # the other way round: by system, component
        self._decisions: dict[tuple[P, int, int], tuple[P, ...]] = {}
        # Which port each frame came from, in the running half of the window and the one before.
        self._seen: dict[bytes, P] = {}
        self._seen_before: dict[bytes, P] = {}
        self._window_ends_at = float("-inf")
        self.refresh_at = float("-inf")
        self.edition = 0
        """Grows whenever an answer of :meth:`route` may have become another."""

    def add_port(self, port: P, *, is_peer: bool = False) -> None:
        """From now on frames may come from and go to this port. Adding it again changes its kind."""
        self._is_peer[port] = is_peer
        self._heard_at.setdefault(port, {})
        self._forget_decisions()

    def remove_port(self, port: P) -> None:
        """Forgets the port and who was behind it."""
        self._is_peer.pop(port, None)
        for address in self._heard_at.pop(port, {}):
            self._unlink(port, address)
        self._forget_decisions()

    def forget_systems(self, port: P, which: Callable[[int], bool]) -> None:
        """Some of the systems that were heard behind a port are no longer looked for there."""
        heard = self._heard_at.get(port, {})
        for address in [each for each in heard if which(each[0])]:
            del heard[address]
            self._unlink(port, address)
        self._forget_decisions()

    def refresh(self, now: float) -> None:
        """Forgets who has gone silent. Due at :attr:`refresh_at`.

        As long as :attr:`edition` stays the same, the ports that :meth:`route` gave for a frame are right for all
        from that source with its header, as far as :meth:`is_first` lets them pass.
        """
        self.refresh_at = now + self._lifetime_s / LIFETIME_PARTS
        self._forget_decisions()
        for port, heard in self._heard_at.items():
            for address in [a for a, heard_at in heard.items() if now - heard_at >= self._lifetime_s]:
                del heard[address]
                self._unlink(port, address)

    def route(self, frame: Frame, source: P, now: float) -> tuple[P, ...]:
        """The ports to send this frame to. Learns its sender; counts why where there is none.

        Raises:
            KeyError: the source is no port that was added.
        """
        heard = self._heard_at[source]
        if not self.is_first(frame.raw, source, now):
            return ()
        header = frame.header
        if header.system != 0:  # 0 means all: no sender is that
            address = (header.system, header.component)
            if address not in heard:
                self._learn(source, address)
            heard[address] = now
        if now >= self.refresh_at:
            self.refresh(now)

        question = (source, header.target_system, header.target_component)
        ports = self._decisions.get(question)
        if ports is None:
            ports = self._decide(*question)
            if len(self._decisions) >= MAX_DECISIONS:
                self._decisions.clear()
            self._decisions[question] = ports
        if not ports:
            self.unrouted[self._why_nowhere(header)] += 1
        return ports

    def is_first(self, raw: bytes, source: P, now: float) -> bool:
        """Whether these bytes came from no other port lately. Remembers them; counts duplicates."""
        if now >= self._window_ends_at:
            self._turn_window(now)
        came_from = self._seen.get(raw)
        if came_from is None:
            came_from = self._seen_before.get(raw, source)
            if came_from == source:
                if len(self._seen) >= MAX_FRAMES_REMEMBERED:
                    self._turn_window(now)
                self._seen[raw] = source
        if came_from == source:
            return True
        self.unrouted[Unrouted.DUPLICATE] += 1
        return False

    def forget_frame(self, raw: bytes) -> None:
        """These bytes were not delivered: should another port send the same, it is the first to do so."""
        self._seen.pop(raw, None)
        self._seen_before.pop(raw, None)

    def addresses(self, port: P) -> list[Address]:
        """The systems and components heard behind a port lately, sorted."""
        return sorted(self._heard_at.get(port, ()))

    def _turn_window(self, now: float) -> None:
        """Forgets the older half of what was seen: each frame is remembered for one to two windows."""
        is_gap = now >= self._window_ends_at + self._window_s
        self._seen_before = {} if is_gap else self._seen
        self._seen = {}
        is_early = now < self._window_ends_at
        self._window_ends_at = (now if is_gap or is_early else self._window_ends_at) + self._window_s

    def _learn(self, port: P, address: Address) -> None:
        heard = self._heard_at[port]
        if len(heard) >= MAX_ADDRESSES_PER_PORT:
            # Whoever makes up addresses crowds out only those behind its own port.
            oldest = next(iter(heard))
            del heard[oldest]
            self._unlink(port, oldest)
        system, component = address
        self._ports_of.setdefault(system, {}).setdefault(component, set()).add(port)
        self._forget_decisions()

    def _forget_decisions(self) -> None:
        self._decisions.clear()
        self.edition += 1

    def _unlink(self, port: P, address: Address) -> None:
        system, component = address
        components = self._ports_of[system]
        components[component].discard(port)
        if not components[component]:
            del components[component]
        if not components:
            del self._ports_of[system]

    def _decide(self, source: P, target_system: int, target_component: int) -> tuple[P, ...]:
        others = [
            port
            for port, is_peer in self._is_peer.items()
            if port != source and (self._relays or not (is_peer and self._is_peer[source]))
        ]
        if target_system == 0:
            return tuple(others)
        components = self._ports_of.get(target_system, {})
        # Component 0 is nobody's own id, even if a sender uses it: it means all of the system.
        of_component = components.get(target_component) if target_component != 0 else None
        heard = of_component or set().union(*components.values())
        if self._floods_unknown and not heard - {source}:
            return tuple(others)
        return tuple(port for port in others if port in heard)

    def _why_nowhere(self, header: Header) -> Unrouted:
        is_unknown = header.target_system != 0 and header.target_system not in self._ports_of
        return Unrouted.UNKNOWN_TARGET if is_unknown else Unrouted.NO_OTHER_PORT
