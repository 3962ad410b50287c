"""Where a frame goes: to the ports behind which its target was received.

A *port* is one local client or one peer, named by any hashable value. The rules are MAVLink's
(https://mavlink.io/en/guide/routing.html), as in mavlink-router and ArduPilot:

* A frame without a target, with target 0, or of a message that cannot be read goes to all other ports. From a local
  client it does not go to another local client that is silent (`Router.set_silent`).
* A frame for a component goes to the ports where that component was received. If the component was received
  nowhere, or the frame is for all components of a system, it goes to the ports where the system was received.
* A frame never goes back to its own port.
* A frame whose target was received nowhere else, or behind its own port alone, goes to all other ports, as in a
  network switch that has not learnt an address. A link must carry the first message to a system that is silent
  until it is asked, and a port that mirrors both sides of a conversation. mavlink-router drops such frames.

Two more rules keep a mesh of daemons from multiplying frames:

* A frame from a peer goes to local ports only, unless this daemon relays.
* A frame that came recently from another port is a duplicate, and dropped. From the same port it is the sender's own
  repetition, and passes.

All ports where an address was received get its frames. So a sender that claims a system's id gets a copy of the
frames for that system, and the real system loses none of them. But a sender that may claim another system's id can
send a frame before that system does, and the real frame is then the duplicate. The policy says which ids a port may
claim. Only frames that passed the policy may be passed to `Router.route`: it learns from them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from enum import StrEnum
from typing import Final, Generic, TypeVar

from uavlinkd.mavlink.frames import Frame

ROUTE_LIFETIME_S: Final = 120.0
"""MAVLink components send a HEARTBEAT each second. On satellite links the interval is some seconds to a minute."""
LIFETIME_PARTS: Final = 8
"""So often per lifetime the router notes which addresses are received and which are silent."""
DUPLICATE_WINDOW_S: Final = 1.0
"""At least, and up to twice that. Longer than the delays of two routes differ, shorter than a sender needs to send
the same bytes again behind another port."""

MAX_ADDRESSES_PER_PORT: Final = 512
MAX_FRAMES_REMEMBERED: Final = 4096  # in each half of the window
MAX_DECISIONS: Final = 4096
MAX_OWN_FRAMES: Final = 64

SystemComponent = tuple[int, int]  # a MAVLink address: system id and component id
P = TypeVar("P", bound=Hashable)


_OWN: Final = object()  # the source of the daemon's own frames


class Unrouted(StrEnum):
    """Why a frame goes nowhere."""

    DUPLICATE = "duplicate"  # it came by another route already
    UNKNOWN_TARGET = "unknown_target"  # its target was not received, or not recently
    NO_OTHER_PORT = "no_other_port"  # its target is behind its own port, or there is no other port


class Router(Generic[P]):
    """Learns which addresses are behind which port, and says where frames go. All times are monotonic seconds."""

    def __init__(self, *, relays: bool = False) -> None:
        self.unrouted: Counter[Unrouted] = Counter()
        self._relays = relays
        self._is_peer: dict[P, bool] = {}  # every port, in the order in which they were added
        self._silent: set[P] = set()
        self._received_at: dict[P, dict[SystemComponent, float]] = {}
        """By port: when each address was received last. The least recently received is first."""
        self._ports_of: dict[int, dict[int, set[P]]] = {}  # the reverse: by system and component
        self._decisions: dict[tuple[P, int, int], tuple[P, ...] | Unrouted] = {}
        self._seen: dict[bytes, Hashable] = {}
        """The port that each frame came from, in the current half of the window."""
        self._seen_before: dict[bytes, Hashable] = {}  # the same for the previous half
        self._own: dict[bytes, None] = {}
        """The daemon's own frames, the oldest first: a client that was stopped returns them late."""
        self._window_ends_at = float("-inf")
        self.refresh_at = float("-inf")
        """When :meth:`refresh` is due."""
        self.edition = 0
        """Grows whenever a result of :meth:`route` may have changed."""

    def add_port(self, port: P, *, is_peer: bool = False) -> None:
        """Accept frames from this port, and send frames to it. Adding it again changes its kind."""
        self._is_peer[port] = is_peer
        self._received_at.setdefault(port, {})
        self._forget_decisions()

    def remove_port(self, port: P) -> None:
        self._is_peer.pop(port, None)
        self._silent.discard(port)
        for address in self._received_at.pop(port, {}):
            self._unlink(port, address)
        self._forget_decisions()

    def set_silent(self, port: P, *, is_silent: bool) -> None:
        """A silent local client gets frames with a target and frames of peers, but no others: it may have gone."""
        if is_silent:
            self._silent.add(port)
        else:
            self._silent.discard(port)
        self._forget_decisions()

    def forget_systems(self, port: P, which: Callable[[int], bool]) -> None:
        """Forget the systems behind a port for which ``which`` is true."""
        received_at = self._received_at.get(port, {})
        for address in [address for address in received_at if which(address[0])]:
            del received_at[address]
            self._unlink(port, address)
        self._forget_decisions()

    def refresh(self, now: float) -> None:
        """Forget the addresses that have been silent for long. Due at :attr:`refresh_at`.

        As long as :attr:`edition` stays the same, the ports that :meth:`route` returned for a frame are valid for all
        frames from that source with its header that are not duplicates (:meth:`is_first`).
        """
        self.refresh_at = now + ROUTE_LIFETIME_S / LIFETIME_PARTS
        self._forget_decisions()
        for port, received_at in self._received_at.items():
            for address in [a for a, at in received_at.items() if now - at >= ROUTE_LIFETIME_S]:
                del received_at[address]
                self._unlink(port, address)

    def route(self, frame: Frame, source: P, now: float) -> tuple[P, ...]:
        """The ports to send this frame to. Learns its sender; counts the reason if there is no port.

        Raises KeyError if the source is not a port that was added.
        """
        received_at = self._received_at[source]
        if frame.raw in self._own:
            self.unrouted[Unrouted.DUPLICATE] += 1
            return ()
        if not self.is_first(frame.raw, source, now):
            return ()
        header = frame.header
        if header.system != 0:  # 0 means all systems: no sender has this id
            address = (header.system, header.component)
            if received_at.pop(address, None) is None:
                self._learn(source, address)
            received_at[address] = now
        if now >= self.refresh_at:
            self.refresh(now)

        question = (source, header.target_system, header.target_component)
        decision = self._decisions.get(question)
        if decision is None:
            decision = self._decide(*question)
            if len(self._decisions) >= MAX_DECISIONS:
                self._decisions.clear()
            self._decisions[question] = decision
        if isinstance(decision, Unrouted):
            self.unrouted[decision] += 1
            return ()
        return decision

    def is_first(self, raw: bytes, source: P, now: float) -> bool:
        """Whether these bytes did not come from another port recently. Remembers them; counts duplicates."""
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

    def note_own(self, raw: bytes, now: float) -> None:
        """The daemon itself sent these bytes to local clients: if a client returns them, they are a duplicate.

        Until the client sends other frames with that header, this holds for the last :data:`MAX_OWN_FRAMES`, else
        for the window of duplicates.
        """
        self._own[raw] = None
        if len(self._own) > MAX_OWN_FRAMES:
            del self._own[next(iter(self._own))]
        if now >= self._window_ends_at or len(self._seen) >= MAX_FRAMES_REMEMBERED:
            self._turn_window(now)
        self._seen[raw] = _OWN

    def forget_frame(self, raw: bytes) -> None:
        """These bytes were not delivered: the same bytes from another port are not a duplicate."""
        self._seen.pop(raw, None)
        self._seen_before.pop(raw, None)

    def addresses(self, port: P) -> list[SystemComponent]:
        """The addresses received behind a port recently, sorted."""
        return sorted(self._received_at.get(port, ()))

    def _turn_window(self, now: float) -> None:
        """Forget the older half of the frames: each is remembered for one to two windows."""
        is_gap = now >= self._window_ends_at + DUPLICATE_WINDOW_S
        self._seen_before = {} if is_gap else self._seen
        self._seen = {}
        is_early = now < self._window_ends_at
        self._window_ends_at = (now if is_gap or is_early else self._window_ends_at) + DUPLICATE_WINDOW_S

    def _learn(self, port: P, address: SystemComponent) -> None:
        received_at = self._received_at[port]
        if len(received_at) >= MAX_ADDRESSES_PER_PORT:
            # A sender that invents addresses displaces only those behind its own port.
            least_recent = next(iter(received_at))
            del received_at[least_recent]
            self._unlink(port, least_recent)
        system, component = address
        self._ports_of.setdefault(system, {}).setdefault(component, set()).add(port)
        self._forget_decisions()

    def _unlink(self, port: P, address: SystemComponent) -> None:
        system, component = address
        components = self._ports_of[system]
        components[component].discard(port)
        if not components[component]:
            del components[component]
        if not components:
            del self._ports_of[system]

    def _forget_decisions(self) -> None:
        self._decisions.clear()
        self.edition += 1

    def _decide(self, source: P, target_system: int, target_component: int) -> tuple[P, ...] | Unrouted:
        """The ports for a target, or why there is none."""
        others = [
            port
            for port, is_peer in self._is_peer.items()
            if port != source and (self._relays or not (is_peer and self._is_peer[source]))
        ]
        if target_system == 0:
            ports = [port for port in others if port not in self._silent or self._is_peer[source]]
            return tuple(ports) or Unrouted.NO_OTHER_PORT
        components = self._ports_of.get(target_system, {})
        # Component 0 is not an id of its own, even if a sender uses it: it means the whole system.
        of_component = components.get(target_component) if target_component != 0 else None
        matches = of_component or set().union(*components.values())
        ports = [port for port in others if port in matches] if matches - {source} else others
        return tuple(ports) or (Unrouted.NO_OTHER_PORT if matches else Unrouted.UNKNOWN_TARGET)
