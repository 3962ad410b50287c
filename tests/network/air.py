"""The radios between the sockets of drones: loss and delay for each path, cuts, and paths that stall.

No node and no drone is known here, only names, numbers of sockets and addresses.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple

from uavlinkd.lab.mitm.radio import Radio, RadioSettings

Address = tuple[str, int]


class Endpoint(NamedTuple):
    """A socket of a drone, whatever its address is now."""

    drone: str
    socket: int = 0


class Hop(NamedTuple):
    """One direction of a path: from a socket of one drone to a socket of another."""

    sender: Endpoint
    receiver: Endpoint

    @property
    def back(self) -> Hop:
        return Hop(self.receiver, self.sender)


Scope = Hop | Endpoint | str | frozenset[str] | None
"""What an interruption concerns: a hop, a socket, a drone, a pair of drones, or everything."""


class Crossing(NamedTuple):
    """A datagram that leaves the radio."""

    datagram: bytes
    source: Address
    destination: Address


@dataclass
class _HopState:
    settings: RadioSettings | None = None
    is_cut: bool = False
    is_stalled: bool = False
    waiting: list[Crossing] = field(default_factory=list)
    """What arrived while the hop was stalled."""


class Air:
    """One radio for each pair of addresses and direction, with the settings of its hop."""

    def __init__(self, seed: int | str, radio: RadioSettings) -> None:
        self.radio = radio
        """For every pair of addresses without an entry of its own."""
        self.cuts: set[tuple[str, str]] = set()
        """Names of sender and receiver between which all datagrams are lost."""
        self.endpoints: dict[Address, Endpoint] = {}
        self.absent: set[Endpoint] = set()
        """Sockets whose network is gone: what is sent there is lost, and nothing arrives."""
        self._seed = seed
        self._hops: dict[Hop, _HopState] = {}
        self._disturbed_at: dict[Scope, float] = {}
        self._radios: dict[tuple[Address, Address], Radio] = {}
        self._arrivals: list[tuple[float, int, Address, Address]] = []
        self._number = 0

    # Where drones are.

    def place(self, drone: str, before: Iterable[Address], after: Sequence[Address]) -> None:
        for address in before:
            self.endpoints.pop(address, None)
        self.endpoints.update((address, Endpoint(drone, socket)) for socket, address in enumerate(after))

    def hop(self, source: Address, destination: Address) -> Hop | None:
        """The hop between two addresses; None unless both are of drones now."""
        sender, receiver = self.endpoints.get(source), self.endpoints.get(destination)
        return None if sender is None or receiver is None else Hop(sender, receiver)

    # What happens to hops. ``now`` is the network's time.

    def set_radio(self, settings: RadioSettings, now: float) -> None:
        """Change all radios from now on; datagrams in flight keep their delay."""
        self.radio = settings
        self.disturb(None, now)
        for state in self._hops.values():
            state.settings = None
        for radio in self._radios.values():
            radio.settings = settings

    def set_hop(self, hop: Hop, settings: RadioSettings, now: float) -> None:
        """Change the radio of one hop from now on, at any addresses that its sockets have."""
        self._change(hop, now).settings = settings
        for (source, destination), radio in self._radios.items():
            if self.hop(source, destination) == hop:
                radio.settings = settings

    def settings_of(self, hop: Hop) -> RadioSettings:
        state = self._hops.get(hop)
        return self.radio if state is None or state.settings is None else state.settings

    def cut(self, hop: Hop, now: float) -> None:
        """Lose everything on this hop from now on, also what is in flight."""
        self._change(hop, now).is_cut = True

    def heal(self, hop: Hop, now: float) -> None:
        self._change(hop, now).is_cut = False

    def heal_all(self, now: float) -> None:
        self.cuts.clear()
        self.disturb(None, now)
        for state in self._hops.values():
            state.is_cut = False

    def stall(self, hop: Hop, now: float) -> None:
        """Keep everything that arrives on this hop from now on."""
        self._change(hop, now).is_stalled = True

    def release(self, hop: Hop, now: float) -> list[Crossing]:
        """End the stall of one hop. Returns what arrived since, in order."""
        state = self._change(hop, now)
        waiting, state.waiting, state.is_stalled = state.waiting, [], False
        return waiting

    def release_all(self, now: float) -> list[Crossing]:
        return [crossing for hop in list(self._hops) for crossing in self.release(hop, now)]

    def disturb(self, scope: Scope, now: float) -> None:
        """Something happened that may stop hops, for a moment or for longer."""
        self._disturbed_at[scope] = now

    def disturbed_at(self, scope: Scope) -> float:
        return self._disturbed_at.get(scope, -math.inf)

    def undisturbed_since(self, hop: Hop) -> float:
        """Since when a hop carries everything, with no other delay than its radio's. Infinity: it does not now."""
        state, settings, (sender, receiver) = self._hops.get(hop) or _HopState(), self.settings_of(hop), hop
        if state.is_cut or state.is_stalled or (sender.drone, receiver.drone) in self.cuts:
            return math.inf
        if sender in self.absent or receiver in self.absent:
            return math.inf
        if settings.loss or settings.bursts or settings.bits_per_s is not None:
            return math.inf
        pair = frozenset((sender.drone, receiver.drone))
        scopes: tuple[Scope, ...] = (hop, sender, receiver, sender.drone, receiver.drone, pair, None)
        return max(self._disturbed_at.get(scope, -math.inf) for scope in scopes)

    def _change(self, hop: Hop, now: float) -> _HopState:
        self.disturb(hop, now)
        return self._hops.setdefault(hop, _HopState())

    # Datagrams.

    def send(self, datagram: bytes, source: Address, destination: Address, now: float) -> None:
        radio = self._radio(source, destination, now)
        waiting = radio.next_deadline()
        radio.send(datagram, now)
        if radio.next_deadline() < waiting:
            self._expect(radio, source, destination)

    def next_arrival(self) -> float:
        """When the next datagram arrives; infinity if none is in flight."""
        return self._arrivals[0][0] if self._arrivals else math.inf

    def arrivals(self, now: float) -> list[Crossing]:
        """What arrives on the next radio now, unless its hop is cut or stalled."""
        _, _, source, destination = heapq.heappop(self._arrivals)
        radio = self._radio(source, destination, now)
        arrived = [Crossing(datagram, source, destination) for datagram in radio.due(now)]
        if arrived:
            self._expect(radio, source, destination)
        hop = self.hop(source, destination)
        if hop is None or not arrived:
            return arrived
        if (hop.sender.drone, hop.receiver.drone) in self.cuts:
            return []
        state = self._hops.get(hop)
        if state is None:
            return arrived
        if state.is_cut:
            return []
        if state.is_stalled:
            state.waiting += arrived
            return []
        return arrived

    def _radio(self, source: Address, destination: Address, now: float) -> Radio:
        key = source, destination
        radio = self._radios.get(key)
        if radio is None:
            rng = Random(f"radio {self._seed} {key}")
            hop = self.hop(source, destination)
            settings = self.radio if hop is None else self.settings_of(hop)
            radio = self._radios[key] = Radio(settings, rng, now)
        return radio

    def _expect(self, radio: Radio, source: Address, destination: Address) -> None:
        if radio.in_flight:
            self._number += 1
            heapq.heappush(self._arrivals, (radio.next_deadline(), self._number, source, destination))
