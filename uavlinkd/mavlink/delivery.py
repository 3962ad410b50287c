"""Delivery of frames to one local client: who they came from, and the byte stream that the client reads."""

from __future__ import annotations

from typing import final

from uavlinkd.mavlink.policy import Gate


@final
class Source:
    """One port that frames come from, as the ports that they go to know it. Compared by identity."""

    __slots__ = ("gate", "name")

    def __init__(self, name: str, gate: Gate) -> None:
        self.name = name
        """The peer or endpoint, as the configuration names it."""
        self.gate = gate
        """The incoming rules that its frames passed."""

    def __repr__(self) -> str:
        return f"Source({self.name})"
