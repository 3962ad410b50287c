"""No critical frame is lost while any path delivers.

A path *delivers* if for :data:`SETTLED_S` before the frame was sent, and :data:`DELIVERED_WITHIN_S` after it, it
carried everything in both directions: no loss, no cut, no stall, at one address at each end, between two daemons that
ran and had each other as a peer. The sender and the receiver have exchanged questions and answers along it in that
time. A path on a metered network is asked less often, and must have delivered for longer.
"""

from __future__ import annotations

from functools import partial

from tests.network.air import Endpoint
from tests.network.drone import Drone
from tests.network.fleet import Fleet, Pair, Route
from uavlinkd.core import constants as c
from uavlinkd.core.settings import Class

SETTLED_S = 10.0
"""A path that was down is asked each second, and is usable again after three answers and 2 s."""
METERED_SETTLED_S = SETTLED_S + 2 * c.PROBE_IDLE_S
DELIVERED_WITHIN_S = 2.0
"""The receiver may ask for a second whether the frame is new; the delay comes on top."""
LONGEST_DELAY_S = 0.35
"""A path with a longer one way delay than this, jitter included, does not count: its answers come too late."""


class CriticalWatch:
    """Sends critical frames between all peers, and checks each of them some time later."""

    def __init__(self, fleet: Fleet) -> None:
        self.sent = 0
        self.judged = 0
        """Frames for which a path delivered."""
        self.judged_on_lines = 0
        """Those of them for which only a serial line did."""
        self._fleet = fleet
        self._network = fleet.network

    def begin(self) -> None:
        for pair in self._fleet.pairs:
            for sender, receiver in ((pair.a, pair.b), (pair.b, pair.a)):
                self._network.at(self._network.now, partial(self._send, pair, sender, receiver))

    def _send(self, pair: Pair, sender: Drone, receiver: Drone) -> None:
        network, (shortest_s, longest_s) = self._network, (0.5, 1.5)
        if network.send(sender, receiver, Class.CRITICAL):
            self.sent += 1
            number = len(network.flow(sender, receiver, Class.CRITICAL).sent_at) - 1
            network.at(network.now + DELIVERED_WITHIN_S, partial(self._check, pair, sender, receiver, number))
        interval_s = self._fleet.lot.uniform(shortest_s, longest_s) * self._fleet.plan.intervals_s[0]
        network.at(network.now + interval_s, partial(self._send, pair, sender, receiver))

    def _check(self, pair: Pair, sender: Drone, receiver: Drone, number: int) -> None:
        flow = self._network.flow(sender, receiver, Class.CRITICAL)
        sent_at = flow.sent_at[number]
        are_peers = _has(sender, receiver) and _has(receiver, sender)
        delivering = self._delivering(pair, sent_at) if are_peers else []
        self.judged += bool(delivering)
        self.judged_on_lines += bool(delivering) and all(hop.sender in self._network.lines for hop, *_ in delivering)
        assert not delivering or number in flow.delivered, (
            f"critical frame {number} from {sender.name} to {receiver.name}, sent at {sent_at:.3f},"
            f" was lost although paths delivered: {delivering}"
        )

    def _delivering(self, pair: Pair, sent_at: float) -> list[Route]:
        """The ways that have delivered from long before a frame was sent until now.

        Through relays there may be more ways than copies. These survive one failure: of a relay, or of a network.
        """
        if self._network.air.disturbed_at(frozenset((pair.a.name, pair.b.name))) > sent_at - SETTLED_S:
            return []
        routes = [route for route in self._fleet.routes(pair) if self._delivered(route, sent_at)]
        if self._fleet.relays:
            failed = [hop for hop in pair.hops if not self._delivered((hop,), sent_at)]
            things: list[set[object]] = [{hop, *hop, hop.receiver.drone} for hop in failed]
            if things and not things[0].intersection(*things[1:]):
                return []
        return routes

    def _delivered(self, route: Route, sent_at: float) -> bool:
        delays_s = [0.0, 0.0]
        for hop in route:
            line = self._network.lines.get(hop.sender)
            if line is not None and not line.is_sound:
                return False
            if any(self._network.drones[end.drone].node is None for end in hop):
                return False
            settled_s = METERED_SETTLED_S if any(map(self._was_metered, hop)) else SETTLED_S
            for direction, one in enumerate((hop, hop.back)):
                radio = self._network.air.settings_of(one)
                held_back_s = radio.held_back_s if radio.reordering else 0.0
                delays_s[direction] += radio.delay_s + radio.jitter_s + held_back_s
                if self._network.air.undisturbed_since(one) > sent_at - settled_s:
                    return False
        return max(delays_s) <= LONGEST_DELAY_S

    def _was_metered(self, end: Endpoint) -> bool:
        return end.socket in self._network.drones[end.drone].once_metered


def _has(drone: Drone, other: Drone) -> bool:
    return drone.node is not None and other.name in drone.node.peers
