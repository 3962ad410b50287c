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
* A frame that is no new sending is dropped (:mod:`.sendings`).

All ports where an address was received get its frames. So a sender that claims a system's id gets a copy of the
frames for that system, and the real system loses none of them. But a sender that may claim another system's id can
send a frame before that system does, and the real frame is then a copy. The policy says which ids a port may
claim. Only frames that passed the policy may be passed to `Router.route`: it learns from them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from enum import StrEnum
from math import inf
from typing import Final, Generic, TypeVar

from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.sendings import Sendings

ROUTE_LIFETIME_S: Final = 120.0
"""MAVLink components send a HEARTBEAT each second. On satellite links the interval is some seconds to a minute."""
LIFETIME_PARTS: Final = 8
"""So often per lifetime the router notes which addresses are received and which are silent."""

MAX_ADDRESSES_PER_PORT: Final = 512

SystemComponent = tuple[int, int]  # a MAVLink address: system id and component id
P = TypeVar("P", bound=Hashable)


class Unrouted(StrEnum):
    """Why a frame goes nowhere."""

    DUPLICATE = "duplicate"  # it came by another route already, or this daemon sent it and it returned
    UNKNOWN_TARGET = "unknown_target"  # its target was not received, or not recently
    NO_OTHER_PORT = "no_other_port"  # its target is behind its own port, or there is no other port


class Router(Generic[P]):
    """Learns which addresses are behind which port, and says where frames go. All times are monotonic seconds."""

    def __init__(self, *, relays: bool = False) -> None:
        self._unrouted: Counter[Unrouted] = Counter()
        self._relays = relays
        self._is_peer: dict[P, bool] = {}  # every port, in the order in which they were added
        self._silent: set[P] = set()
        self._received_at: dict[P, dict[SystemComponent, float]] = {}
        """By port: when each address was received last. The least recently received is first."""
        self._ports_of: dict[int, dict[int, set[P]]] = {}  # the reverse: by system and component
        self._routes: dict[P, Hashable] = {}
        self.sendings = Sendings(self._routes, self._received_at)
        self._forget_at = -inf
        """When silent addresses are to be forgotten."""
        self.valid_until = -inf
        """Until when results of :meth:`route` stay the same: then, or in the past, :meth:`refresh` is due."""

    @property
    def unrouted(self) -> Counter[Unrouted]:
        """Frames that went nowhere, by reason."""
        return +Counter({**self._unrouted, Unrouted.DUPLICATE: self.sendings.dropped})

    def add_port(self, port: P, *, is_peer: bool = False, endpoint: Hashable = None) -> None:
        """Accept frames from this port, and send frames to it. Adding it again changes its kind.

        ``endpoint``: that of a local client. All clients of one endpoint are one route.
        """
        self._is_peer[port] = is_peer
        self._routes[port] = port if is_peer else endpoint
        self._received_at.setdefault(port, {})
        self.valid_until = -inf

    def remove_port(self, port: P) -> None:
        self._is_peer.pop(port, None)
        self._routes.pop(port, None)
        self.sendings.circles.pop(port, None)
        self._silent.discard(port)
        for address in self._received_at.pop(port, {}):
            self._unlink(port, address)
        self.valid_until = -inf

    def set_silent(self, port: P, *, is_silent: bool) -> None:
        """A silent local client gets frames with a target and frames of peers, but no others: it may have gone."""
        if is_silent:
            self._silent.add(port)
        else:
            self._silent.discard(port)
        self.valid_until = -inf

    def forget_systems(self, port: P, which: Callable[[int], bool]) -> None:
        """Forget the systems behind a port for which ``which`` is true."""
        received_at = self._received_at.get(port, {})
        for address in [address for address in received_at if which(address[0])]:
            del received_at[address]
            self._unlink(port, address)
        self.valid_until = -inf

    def refresh(self, now: float) -> None:
        """Forget the addresses that have been silent for long. Due at :attr:`valid_until`.

        Until it is due again, the ports that :meth:`route` returned for a frame are valid for all frames from that
        source with its header that are new (:meth:`.Sendings.is_new`).
        """
        if now < self._forget_at:
            self.valid_until = self._forget_at
            return
        self.valid_until = self._forget_at = now + ROUTE_LIFETIME_S / LIFETIME_PARTS
        for port, received_at in self._received_at.items():
            for address in [a for a, at in received_at.items() if now - at >= ROUTE_LIFETIME_S]:
                del received_at[address]
                self._unlink(port, address)

    def route(self, frame: Frame, source: P, now: float) -> tuple[P, ...]:
        """The ports to send this frame to. Learns its sender; counts the reason if there is no port.

        Raises KeyError if the source is not a port that was added.
        """
        received_at = self._received_at[source]
        if now >= self._forget_at:
            self.refresh(now)
            self.valid_until = -inf
        header = frame.header
        ports = self._ports_for(source, header.target_system, header.target_component)
        if not self.sendings.is_new(frame, source, ports, now):
            return ()
        if header.system != 0:  # 0 means all systems: no sender has this id
            address = (header.system, header.component)
            if received_at.pop(address, None) is None:
                self._learn(source, address)
                ports = self._ports_for(source, header.target_system, header.target_component)
            received_at[address] = now
        if not ports:
            is_known = header.target_system == 0 or header.target_system in self._ports_of
            self._unrouted[Unrouted.NO_OTHER_PORT if is_known else Unrouted.UNKNOWN_TARGET] += 1
        return ports

    def addresses(self, port: P) -> list[SystemComponent]:
        """The addresses received behind a port recently, sorted."""
        return sorted(self._received_at.get(port, ()))

    def _learn(self, port: P, address: SystemComponent) -> None:
        received_at = self._received_at[port]
        if len(received_at) >= MAX_ADDRESSES_PER_PORT:
            # A sender that invents addresses displaces only those behind its own port.
            least_recent = next(iter(received_at))
            del received_at[least_recent]
            self._unlink(port, least_recent)
        system, component = address
        self._ports_of.setdefault(system, {}).setdefault(component, set()).add(port)
        self.valid_until = -inf

    def _unlink(self, port: P, address: SystemComponent) -> None:
        system, component = address
        components = self._ports_of[system]
        components[component].discard(port)
        if not components[component]:
            del components[component]
        if not components:
            del self._ports_of[system]

    def _ports_for(self, source: P, target_system: int, target_component: int) -> tuple[P, ...]:
        others = [
            port
            for port, is_peer in self._is_peer.items()
            if port != source and (self._relays or not (is_peer and self._is_peer[source]))
        ]
        if target_system == 0:
            return tuple(port for port in others if port not in self._silent or self._is_peer[source])
        components = self._ports_of.get(target_system, {})
        # Component 0 is not an id of its own, even if a sender uses it: it means the whole system.
        of_component = components.get(target_component) if target_component != 0 else None
        matches = of_component or set().union(*components.values())
        return tuple(port for port in others if port in matches) if matches - {source} else tuple(others)
