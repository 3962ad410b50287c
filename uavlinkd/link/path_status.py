"""The paths of a peer in the status, and their rates."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol

from uavlinkd.core.path import Path, SocketAddress
from uavlinkd.core.path_state import PathState
from uavlinkd.core.peer import Peer
from uavlinkd.link.shown import relay_name, shown
from uavlinkd.system.addresses import Address

NetworkOf = Callable[[int], str | None]
"""The name of the network of a socket's number; None if the configuration names no networks."""
RelayAddressOf = Callable[[Path], SocketAddress | None]
"""The relay's address along a relayed path; None for another path."""


class PathRates:
    """Bytes a second along each path, received and sent, between the last two measurements."""

    def __init__(self) -> None:
        self._measured_at = 0.0
        self._totals: dict[PathState, tuple[int, int]] = {}
        self._rates: dict[PathState, tuple[float, float]] = {}

    def measure(self, states: Iterable[PathState], now: float) -> None:
        """Read the totals of the paths that a peer has now. Call it about once a second."""
        elapsed_s = now - self._measured_at
        if elapsed_s <= 0:
            return
        totals = {state: (state.bytes_received, state.bytes_sent) for state in states}
        self._rates = {
            state: (
                (received - self._totals[state][0]) / elapsed_s,
                (sent - self._totals[state][1]) / elapsed_s,
            )
            for state, (received, sent) in totals.items()
            if state in self._totals
        }
        self._measured_at, self._totals = now, totals

    def of(self, state: PathState) -> tuple[float, float]:
        """Bytes received and sent a second along a path; 0 until it was measured twice."""
        return self._rates.get(state, (0.0, 0.0))


class PathsOwner(Protocol):
    """The link whose paths are described."""

    rates: PathRates

    @property
    def peer(self) -> Peer:
        """Its object in the core."""


def paths_status(
    link: PathsOwner, network_of: NetworkOf, now: float, relay_address_of: RelayAddressOf = lambda _: None
) -> list[dict[str, object]]:
    """Each path to a peer as plain values, the best first, then the configured ones.

    ``carries`` has the classes of frames that go along it now. Losses are shares of recent datagrams, ``lag_s`` is by
    how much our copies arrive later along it than along the first path. ``number`` stays the same as long as the path
    is known, and is below 256. ``relay`` is the one through which it leads, and ``relay_address`` where it is
    reached; null for a direct path.
    """
    paths = link.peer.paths
    states = sorted(paths.states, key=lambda state: state is not paths.best)
    return [_path_status(link, state, network_of, now, relay_address_of(state.path)) for state in states]


def _path_status(
    link: PathsOwner, state: PathState, network_of: NetworkOf, now: float, relay_address: SocketAddress | None
) -> dict[str, object]:
    peer = link.peer
    bytes_in_s, bytes_out_s = link.rates.of(state)
    return {
        "number": state.number,
        "network": network_of(state.path.socket),
        "address": shown(state.path.address),
        "relay": relay_name(state.path.address),
        "relay_address": None if relay_address is None else str(Address.of(relay_address)),
        "is_configured": state.is_configured,
        "state": state.condition.value,
        "reason": state.reason,
        "state_s": now - state.since,
        "role": peer.paths.role(state),
        "carries": [cls.value for cls, route in peer.paths.routes.items() if peer.is_up and state in route],
        "answered_s": now - state.answered_at if state.is_validated else None,
        "round_trip_s": state.srtt_s,
        "jitter_s": state.rttvar_s,
        "loss_in": state.loss_in,
        "loss_out": state.loss_out,
        "lag_s": state.lag_s(now),
        "bytes_in_s": bytes_in_s,
        "bytes_out_s": bytes_out_s,
        "bytes_received": state.bytes_received,
        "bytes_sent": state.bytes_sent,
        "datagrams_received": state.datagrams_received,
        "datagrams_sent": state.datagrams_sent,
        "duplicates": state.duplicates,
    }
