"""Buckets of bytes: the budget of a peer or of a network, and which of them the frames of one peer need.

A bucket fills at the budget's rate. Every datagram empties it by all its bytes on the wire. It holds a quarter of a
second of the budget, or one largest frame in an envelope if that is more. So a radio's own buffer never holds more of
these frames than that.

Peers that share the bucket of a network take turns. A queue of frames that waits for the bucket is in line, with
the price of its next envelope. Urgent frames go first, otherwise the queue that waited longest. Without turns, the
queue with the cheapest envelopes would leave nothing to the others. Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, inf
from typing import Final

BURST_S: Final = 0.25
"""The bucket holds this much of the budget: a command waits for no more than this in a radio's own buffer."""
DEBT_S: Final = 1.0
"""The bucket can be in debt, because the core's own datagrams are never refused. The debt is at most this much: the
handshakes of a long outage must not silence the link after it."""
DEMAND_WINDOW_S: Final = 2.0


class Bucket:
    """One budget. ``least_burst``: what it holds at least, in bytes, however low the budget is."""

    __slots__ = ("_bytes", "_least_burst", "_line", "_now", "_offered", "burst", "rate")

    keeps_order = False
    """Whether frames that wait for it leave in the order of arrival: no frame replaces or overtakes another one."""

    def __init__(self, budget_bits_s: float, now: float, least_burst: float = 0.0) -> None:
        self.rate = budget_bits_s / 8
        self.burst = 0.0  # the most bytes that it holds
        self.set_least_burst(least_burst)
        self._bytes = self.burst
        self._offered = 0.0  # bytes sent and dropped, fading over the window
        # The queues that wait, the longest waiting first: the price in bytes, and whether it is urgent.
        self._line: dict[object, tuple[float, bool]] = {}
        self._now = now

    def set_rate(self, bytes_s: float, now: float) -> None:
        self.level(now)
        self.rate = bytes_s
        self.set_least_burst(self._least_burst)

    def set_least_burst(self, least_burst: float) -> None:
        self._least_burst = least_burst
        self.burst = max(self.rate * BURST_S, least_burst)

    def level(self, now: float) -> float:
        """The bytes that may be spent now; negative in debt."""
        elapsed = now - self._now
        if elapsed > 0:
            self._now = now
            self._bytes = min(self.burst, self._bytes + elapsed * self.rate)
            self._offered *= exp(-elapsed / DEMAND_WINDOW_S)
        return self._bytes

    def spend(self, wire_bytes: float, now: float) -> None:
        """Charge bytes that are sent, whether or not the bucket covers them."""
        self._offered += wire_bytes
        if self.level(now) > -DEBT_S * self.rate:
            self._bytes -= wire_bytes

    def wait_s(self, price: float, now: float) -> float:
        """How long until it has so many bytes, if nothing is sent meanwhile."""
        return max(0.0, (price - self.level(now)) / self.rate)

    # Turns.

    def claim(self, queue: object, price: float, *, is_urgent: bool) -> None:
        """A queue waits for its turn, or its next envelope has another price now."""
        self._line[queue] = price, is_urgent

    def leave(self, queue: object) -> None:
        """A queue had its turn, or has no frames."""
        self._line.pop(queue, None)

    def price_before(self, queue: object, *, is_urgent: bool) -> float:
        """The bytes that other queues need before it is this one's turn."""
        before, is_behind = 0.0, False
        for other, (price, is_other_urgent) in self._line.items():
            if other is queue:
                is_behind = True
            elif is_other_urgent > is_urgent or (is_other_urgent == is_urgent and not is_behind):
                before += price
        return before

    # Demand.

    def note_dropped(self, frame_bytes: int) -> None:
        """Frames were dropped for lack of budget: they were demanded too."""
        self._offered += frame_bytes

    def demand(self, now: float) -> float:
        """The bytes sent and dropped over the last seconds, as a share of the budget."""
        self.level(now)
        return self._offered / (DEMAND_WINDOW_S * self.rate)


class Supply:
    """What some frames to one peer may use: the peer's own bucket, and that of any one of the networks.

    ``own``: None for a peer without a budget. ``networks``: those along which the frames may go; None for a network
    without a budget, which always has room.
    """

    __slots__ = ("keeps_order", "networks", "own", "rate")

    def __init__(self, own: Bucket | None = None, networks: Sequence[Bucket | None] = (None,)) -> None:
        self.own = own
        limited = [network for network in networks if network is not None]
        self.networks = tuple(limited) if len(limited) == len(networks) else ()
        self.keeps_order = own is None and all(network.keeps_order for network in self.networks)
        self.rate = min(
            inf if own is None else own.rate, max((network.rate for network in self.networks), default=inf)
        )
        """In bytes a second; infinite without a budget."""

    @property
    def burst(self) -> float:
        most = max((network.burst for network in self.networks), default=inf)
        return most if self.own is None else min(most, self.own.burst)

    def level(self, now: float) -> float:
        level = max(network.level(now) for network in self.networks) if self.networks else inf
        return level if self.own is None else min(level, self.own.level(now))

    def room_for(self, queue: object, price: float, now: float, *, is_urgent: bool) -> float:
        """The bytes that this queue may use now for an envelope of this price; 0 if it has to wait.

        The queue is in line from then on, if it has to wait, until it has room or :meth:`leave` is called.
        """
        own = inf if self.own is None else self.own.level(now)
        if own < price:
            self.leave(queue)
            return 0.0
        if not self.networks:
            return own
        levels = [
            max(level, price)
            for network in self.networks
            if (level := network.level(now)) >= min(price, network.burst)  # a longer envelope goes into debt
            and not network.price_before(queue, is_urgent=is_urgent)
        ]
        if levels:
            self.leave(queue)
            return min(own, max(levels))
        for network in self.networks:
            network.claim(queue, price, is_urgent=is_urgent)
        return 0.0

    def leave(self, queue: object) -> None:
        for network in self.networks:
            network.leave(queue)

    def wait_s(self, queue: object, price: float, now: float, *, is_urgent: bool) -> float:
        """How long until the queue has room for an envelope of this price, as far as that is known."""
        waits = [
            network.wait_s(min(price, network.burst) + network.price_before(queue, is_urgent=is_urgent), now)
            for network in self.networks
        ]
        wait_s = min(waits, default=0.0)
        return wait_s if self.own is None else max(wait_s, self.own.wait_s(price, now))

    def note_dropped(self, frame_bytes: int) -> None:
        if self.own is not None:
            self.own.note_dropped(frame_bytes)
        for network in self.networks:
            network.note_dropped(frame_bytes)

    def demand(self, now: float) -> float:
        """The bytes sent and dropped over the last seconds, as a share of the tightest budget; 0 without a budget."""
        least = min((network.demand(now) for network in self.networks), default=0.0)
        return least if self.own is None else max(least, self.own.demand(now))
