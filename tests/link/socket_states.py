"""A core that notes the reports about sockets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from uavlinkd.core.node import Node


class SocketStateLog(Node):
    """The states of sockets in the order in which they were reported, and the numbers of the metered ones."""

    def __init__(self) -> None:  # without peers
        self.states: list[tuple[int, bool]] = []
        self.metered: list[int] = []

    def set_socket_state(self, socket: int, now: float, *, is_up: bool) -> None:
        """As the core's."""
        self.states.append((socket, is_up))

    def set_metered(self, sockets: Iterable[int], now: float) -> None:
        """As the core's."""
        self.metered = list(sockets)

    def set_budgets(self, budgets: Mapping[int, float]) -> None:
        """As the core's."""

    def set_envelope_limits(self, limits: Mapping[int, int]) -> None:
        """As the core's."""
