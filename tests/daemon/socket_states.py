"""A core that notes the reports about sockets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from uavlinkd.protocol.node import Node
from uavlinkd.protocol.path import Path, SocketFacts


class SocketStateLog(Node):
    """The states of sockets in the order in which they were reported, and the numbers of the metered ones."""

    def __init__(self) -> None:  # without peers
        self.states: list[tuple[int, bool]] = []
        self.metered: list[int] = []
        self.facts = SocketFacts()
        self.removed: list[Path] = []
        self.rates: list[Mapping[int, float]] = []

    def set_socket_state(self, socket: int, now: float, *, is_up: bool) -> None:
        """As the core's."""
        self.states.append((socket, is_up))

    def set_rates(self, rates: Mapping[int, float], now: float) -> None:
        """As the core's."""
        self.rates.append(rates)

    def remove_path(self, path: Path, now: float) -> None:
        """As the core's."""
        self.removed.append(path)

    def set_metered(self, sockets: Iterable[int], now: float) -> None:
        """As the core's."""
        self.metered = list(sockets)
